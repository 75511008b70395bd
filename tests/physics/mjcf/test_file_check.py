"""What an MJCF may read: everything that MuJoCo opens is found first, nothing outside the folder is touched."""

import os
from pathlib import Path

import mujoco
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.physics.mjcf import file_check
from tableverse_factory.physics.mjcf.file_check import check_files, load_mjcf
from tableverse_factory.physics.mjcf.load import load_model
from tests.helpers.captures_on_disk import huge_png

TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BODY = '<worldbody><body><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>'


def mesh(file: str, settings: str = "") -> str:
    return f'<mujoco>{settings}<asset><mesh name="m" file="{file}"/></asset>{BODY}</mujoco>'


def write(home: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text(text)
    return home / "scene.xml"


GOOD = {
    "beside": {"scene.xml": mesh("m.obj"), "m.obj": TETRAHEDRON},
    "meshdir": {"scene.xml": mesh("m.obj", '<compiler meshdir="a/b"/>'), "a/b/m.obj": TETRAHEDRON},
    "assetdir": {"scene.xml": mesh("c/m.obj", "<compiler assetdir='a'/>"), "a/c/m.obj": TETRAHEDRON},
    "later settings": {
        "scene.xml": mesh("m.obj").replace("</muj", '<compiler meshdir="d"/></muj'),
        "d/m.obj": TETRAHEDRON,
    },
    "last part": {"scene.xml": mesh("/no/where/m.obj", '<compiler strippath="true"/>'), "m.obj": TETRAHEDRON},
    "back and forth": {"scene.xml": mesh("a/../m.obj"), "m.obj": TETRAHEDRON, "a/x": ""},
    "back from nowhere": {"scene.xml": mesh("nope/../m.obj"), "m.obj": TETRAHEDRON},
    "up from a setting": {"scene.xml": mesh("../m.obj", '<compiler meshdir="a"/>'), "m.obj": TETRAHEDRON},
    "up from a setting that comes later": {
        "scene.xml": mesh("../m.obj", '<include file="b.xml"/>'),
        "b.xml": '<mujoco><compiler meshdir="a"/></mujoco>',
        "m.obj": TETRAHEDRON,
    },
    "a name with an ampersand": {"scene.xml": mesh("a&amp;b.obj"), "a&b.obj": TETRAHEDRON},
    "a name with a space": {"scene.xml": mesh(" m.obj"), " m.obj": TETRAHEDRON},
    "a comment with dashes": {"scene.xml": "<!-- ---- meshes ---- -->" + mesh("m.obj"), "m.obj": TETRAHEDRON},
    "settings elsewhere": {
        "scene.xml": mesh("m.obj", '<include file="parts/settings.txt"/>'),
        "parts/settings.txt": '<mujoco><compiler meshdir="d"/></mujoco>',
        "d/m.obj": TETRAHEDRON,
    },
    "included twice over": {
        "scene.xml": f'<mujoco><include file="parts/one.xml"/>{BODY}</mujoco>',
        "parts/one.xml": '<mujoco><include file="two.xml"/></mujoco>',
        "parts/two.xml": '<mujoco><asset><mesh name="m" file="m.obj"/></asset></mujoco>',
        "m.obj": TETRAHEDRON,
        "parts/m.obj": TETRAHEDRON,
    },
    "another model": {
        "scene.xml": '<mujoco><asset><model name="k" file="k/k.xml"/></asset><worldbody><body><freejoint/>'
        '<attach model="k" body="b" prefix="p"/></body></worldbody></mujoco>',
        "k/k.xml": mesh("m.obj").replace("<body>", '<body name="b">').replace("<freejoint/>", ""),
        "k/m.obj": TETRAHEDRON,
    },
}


@pytest.mark.parametrize("case", GOOD)
def test_what_mujoco_opens_is_found_first(tmp_path: Path, case: str) -> None:
    scene = write(tmp_path, GOOD[case])
    assert load_mjcf(scene).nmesh == 1
    opened = {Path(os.path.normpath(name)) for name in mujoco.mju_getXMLDependencies(str(scene)) if Path(name).exists()}
    assert opened <= {Path(os.path.normpath(path)) for path in check_files(scene, tmp_path)}


OUTSIDE = {
    "up": mesh("../secret.obj"),
    "up, in single quotes": mesh("m.obj").replace('"m.obj"', "'../secret.obj'"),
    "up, as entities": mesh("&#46;&#x2e;/secret.obj"),
    "up, the other way round": mesh("..\\secret.obj"),
    "up by a setting": mesh("secret.obj", '<compiler meshdir=".."/>'),
    "up by what is included": '<mujoco><include file="../other.xml"/></mujoco>',
    "up through a disguise": '<mujoco><include file="disguise.obj"/></mujoco>',
    "by a link": mesh("link.obj"),
    "device": mesh("/dev/zero"),
    "pipe": mesh("pipe.obj"),
    "up through a folder that is not there": mesh("nope/../../secret.obj"),
    "the same, included": '<mujoco><include file="nope/../../other.xml"/></mujoco>',
    "the same, by a setting": mesh("secret.obj", '<compiler meshdir="nope/../.."/>'),
    "up through a long name": mesh("nope/...//./../../../secret.obj"),
    "anywhere through a folder that is not there": mesh("/nope/..TOP/secret.obj"),
    "up through what HTML calls an entity": mesh("&ampx/../../secret.obj"),
    "up through a space": mesh(" /../../secret.obj"),
    "up after a space": mesh(" ../secret.obj"),
    "up to nothing": mesh("../absent.obj"),
    "anywhere, to nothing": mesh("/nope/absent.obj"),
    "up through a link": mesh("folder/../secret.obj"),
    "device through a folder that is not there": mesh("/nope/../dev/zero"),
    "pipe through a folder that is not there": mesh("nope/../pipe.obj"),
    "a link before the end of the name": mesh("link.obj&#0;.obj"),
    "a link with a control character": mesh("&#1;.obj"),
    "a link with a character that HTML replaces": mesh("&#x80;.obj"),
    "a link with leading zeros": mesh("&#" + "0" * 30 + "108;ink.obj"),
    "a link after a space": mesh(" link.obj"),
    "a link in no encoding": mesh("\udcff.obj"),
    "a drive": mesh("C:\\..\\..\\..\\secret.obj"),
}


@pytest.mark.parametrize("case", OUTSIDE)
def test_nothing_outside_is_read(tmp_path: Path, case: str) -> None:
    home = tmp_path / "home"
    scene = write(home, {"scene.xml": "", "disguise.obj": 'v 0 0 0 <mujoco><include file="../other.xml"/>'})
    scene.write_bytes(os.fsencode(OUTSIDE[case].replace("TOP", str(tmp_path))))
    (tmp_path / "secret.obj").write_text(TETRAHEDRON)
    (tmp_path / "other.xml").write_text("<mujoco/>")
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "far" / "secret.obj").write_text(TETRAHEDRON)
    (home / "folder").symlink_to(tmp_path / "far" / "away")
    for name in ("link.obj", "\x01.obj", "\x80.obj", " link.obj", "\udcff.obj"):
        (home / name).symlink_to(tmp_path / "secret.obj")
    os.mkfifo(home / "pipe.obj")
    with pytest.raises(InputError, match=r"lies outside|no regular file|no plain path"):
        load_mjcf(scene)


def test_a_wider_folder_can_be_named(tmp_path: Path) -> None:
    scene = write(tmp_path / "a", {"scene.xml": mesh("../meshes/m.obj")})
    write(tmp_path / "meshes", {"m.obj": TETRAHEDRON})
    with pytest.raises(InputError, match=r"'../meshes/m.obj', which lies outside .*--root"):
        load_mjcf(scene)
    assert load_mjcf(scene, tmp_path).nmesh == 1


def test_bounds_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, {f"{n}.xml": f'<mujoco><include file="{n + 1}.xml"/></mujoco>' for n in range(80)})
    scene = write(tmp_path, {"scene.xml": '<mujoco><include file="0.xml"/></mujoco>'})
    with pytest.raises(InputError, match="at most 64 documents"):
        load_mjcf(scene)
    scene = write(tmp_path / "b", GOOD["beside"])
    monkeypatch.setattr(file_check, "MAX_TOTAL_BYTES", scene.stat().st_size + 10)
    with pytest.raises(InputError, match=r"with 'm\.obj' more than"):
        load_mjcf(scene)
    monkeypatch.undo()
    names = "".join(f'<mesh file="{n}.obj"/>' for n in range(20_001))
    with pytest.raises(InputError, match="too many files"):
        load_mjcf(write(tmp_path / "c", {"scene.xml": f"<mujoco><asset>{names}</asset></mujoco>"}))


def test_a_picture_that_nobody_should_decode_is_refused_by_its_header(tmp_path: Path) -> None:
    texture = '<mujoco><asset><texture name="t" type="2d" file="t.png"/></asset><worldbody/></mujoco>'
    scene = write(tmp_path, {"scene.xml": texture})
    (tmp_path / "t.png").write_bytes(huge_png(60_000, 60_000))
    with pytest.raises(InputError, match=r"'t\.png': 60000 x 60000 pixels"):
        load_mjcf(scene)


def test_what_mujoco_refuses_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="MuJoCo does not load it") as caught:
        load_mjcf(write(tmp_path, {"scene.xml": mesh("x" * 5000)}))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["/etc/hostname", "../../x.obj", "absent.obj", " m.obj", "nope/../m.obj"])
def test_a_scene_from_memory_reads_nothing_from_the_disk(name: str) -> None:
    settings = '<compiler meshdir="assets"/>'
    files = {"scene.xml": mesh("m.obj", settings).encode(), "assets/m.obj": TETRAHEDRON.encode()}
    assert load_model(files).nmesh == 1
    with pytest.raises(InputError, match="none of its files"):
        load_model({**files, "scene.xml": mesh(name, settings).encode()})
    with pytest.raises(InputError, match="none of its files"):
        load_model({**files, "scene.xml": mesh("m.obj", f'<compiler meshdir="{name}"/>').encode()})

"""Files that MuJoCo loads and no figure would be true of: refused in one line, whoever wrote them."""

import json
from pathlib import Path

import mujoco
import pytest
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.physics.mjcf.load import load_model

FLOATING = """<mujoco><option {option}/><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 {height}" {body}>
<freejoint/><geom type="box" size=".05 .05 .05" {geom}/></body></worldbody></mujoco>"""


def text(option: str = "", body: str = "", geom: str = "", height: str = "1") -> str:
    return FLOATING.format(option=option, body=body, geom=geom, height=height)


NANS = {"height": "nan", "body": 'quat="nan 0 0 0"', "geom": 'mass="nan"'}


@pytest.mark.parametrize(
    ("document", "said"),
    [
        (text(height="nan"), "it holds a NaN"),
        (text(height="inf"), "body_pos holds inf"),
        (text(body='quat="nan 0 0 0"'), "it holds a NaN"),
        (text(option='gravity="0 0 -inf"'), "option.gravity holds -inf"),
        (text(geom='mass="nan"'), "it holds a NaN"),
        (text(option='timestep="0"'), "the timestep is 0 s; drift is measured with 1e-05 to 0.05 s"),
        (text(option='timestep="-.002"'), "the timestep is -0.002 s"),
        (text(option='timestep="11"'), "the timestep is 11 s"),
        (text(option='timestep="1e-9"'), "the timestep is 1e-09 s"),
    ],
)
def test_verify_refuses_what_it_cannot_measure(
    document: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(document)
    result = CliRunner().invoke(app, ["verify", "scene.xml"])
    assert result.exit_code == 1
    assert said in (str(result.exception) if isinstance(result.exception, InputError) else result.stdout)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"], "MuJoCo's log file"


@pytest.mark.parametrize("step", ["1e-4", "0.002", "0.05"])
def test_steps_within_the_bounds_show_that_a_floating_box_falls(step: str, tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(text(option=f'timestep="{step}"'))
    result = CliRunner().invoke(app, ["verify", str(tmp_path / "scene.xml"), "--json"])
    assert result.exit_code == 1
    assert json.loads(result.stdout)["scenes"][0]["drift_m"] == pytest.approx(0.95, abs=0.05)


@pytest.mark.parametrize(
    ("document", "said"),
    [(text(height="inf"), "body_pos holds inf"), *((text(**{k: v}), "holds a NaN") for k, v in NANS.items())],
)
def test_a_scene_in_memory_is_held_to_the_same(
    document: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mujoco.set_mju_user_warning(print)
    with pytest.raises(InputError, match=said):
        load_model({"scene.xml": document.encode()})
    assert mujoco.get_mju_user_warning() is print, "who listens to MuJoCo goes on listening"
    mujoco.set_mju_user_warning(None)
    assert not list(tmp_path.iterdir()), "MuJoCo's log file"

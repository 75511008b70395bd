"""USD in the hands of importers and validators that others wrote: the scene rests there, and nothing is amiss."""

import mujoco
import numpy as np
import pytest

from tableverse_factory.delivery.formats.extract import extract_scene
from tableverse_factory.delivery.formats.model_contents import read_model_contents
from tableverse_factory.delivery.formats.usd import encode_usd
from tests.helpers.exported_scenes import exported

NAMES = ("obj_000", "obj_001", "obj_002")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    pytest.importorskip("pxr", reason="usd-core is an optional extra")
    dest = tmp_path_factory.mktemp("usd") / "scene"
    extract_scene(exported(), dest, "usd")
    return dest


def test_what_usd_lacks_stands_in_the_attributes_of_mujoco_and_newton(folder):
    from pxr import Usd, UsdShade

    stage, model = Usd.Stage.Open(str(folder / "scene.usd")), exported().model()
    physics = stage.GetPrimAtPath("/World/physics")
    assert {"MjcSceneAPI", "NewtonSceneAPI"} <= set(physics.GetPrimTypeInfo().GetAppliedAPISchemas())
    found = {name: physics.GetAttribute(f"mjc:option:{name}").Get() for name in ("cone", "integrator", "impratio")}
    assert found == {"cone": "elliptic", "integrator": "implicitfast", "impratio": 100.0}
    assert physics.GetAttribute("mjc:option:noslip_iterations").Get() == 5
    assert physics.GetAttribute("mjc:option:timestep").Get() == model.opt.timestep
    assert physics.GetAttribute("physics:gravityMagnitude").Get() == pytest.approx(9.81)
    assert physics.GetAttribute("newton:timeStepsPerSecond").Get() == round(1 / model.opt.timestep)
    for name in NAMES:
        piece, geom = stage.GetPrimAtPath(f"/World/{name}/piece_00"), model.geom(f"{name}_piece_00")
        np.testing.assert_allclose(piece.GetAttribute("mjc:solref").Get(), geom.solref)
        np.testing.assert_allclose(piece.GetAttribute("mjc:solimp").Get(), geom.solimp)
        assert piece.GetAttribute("mjc:condim").Get() == 6
        assert piece.GetAttribute("newton:contactGap").Get() == 0.0
        material = UsdShade.MaterialBindingAPI(piece).ComputeBoundMaterial("physics")[0].GetPrim()
        frictions = [material.GetAttribute(f"newton:{kind}Friction").Get() for kind in ("torsional", "rolling")]
        np.testing.assert_allclose(frictions, geom.friction[1:], rtol=1e-6)


TWO_COLLIDERS = """<mujoco><worldbody>
  <geom name="floor" type="box" size="1 1 0.1" pos="0 0 -0.1" friction="0.7 0.02 0.0003" solref="0.01 1"/>
  <body name="lamp" pos="0 0 0.05"><freejoint/>
    <geom type="box" size="0.05 0.05 0.05" friction="0.9 0.01 0.002" condim="6" solref="0.004 1"
      solimp="0.99 0.999 0.0002"/>
    <geom type="sphere" size="0.03" pos="0 0 0.08" friction="0.3 0.005 0.0001" condim="4" solref="0.02 0.8"/>
    <geom type="box" size="0.01 0.01 0.01" pos="0 0 0.12" friction="0.9 0.01 0.002" condim="3"/>
  </body></worldbody></mujoco>"""


def test_each_collider_has_its_own_contact_settings(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is an optional extra")
    from pxr import Usd, UsdShade

    model = mujoco.MjModel.from_xml_string(TWO_COLLIDERS)
    (tmp_path / "scene.usd").write_bytes(encode_usd(read_model_contents(model), {})["scene.usd"])
    stage = Usd.Stage.Open(str(tmp_path / "scene.usd"))
    materials = []
    for geom, path in enumerate(["world/piece_00", *(f"lamp/piece_{index:02d}" for index in range(3))]):
        piece = stage.GetPrimAtPath(f"/World/{path}")
        assert piece.GetAttribute("mjc:condim").Get() == model.geom_condim[geom]
        np.testing.assert_allclose(piece.GetAttribute("mjc:solref").Get(), model.geom_solref[geom])
        np.testing.assert_allclose(piece.GetAttribute("mjc:solimp").Get(), model.geom_solimp[geom])
        material = UsdShade.MaterialBindingAPI(piece).ComputeBoundMaterial("physics")[0].GetPrim()
        names = ("physics:staticFriction", "newton:torsionalFriction", "newton:rollingFriction")
        np.testing.assert_allclose(
            [material.GetAttribute(n).Get() for n in names], model.geom_friction[geom], rtol=1e-6
        )
        materials.append(material.GetPath())
    assert materials[1] == materials[3] != materials[2], "equal frictions share a material"


@pytest.mark.slow
def test_the_scene_rests_in_mujoco_s_own_importer_of_usd(folder):
    """Run with mujoco-usd 4.0.1, which needs mujoco-core 4.0.1 and usd-core 25.11."""
    pytest.importorskip("mujoco._usd", reason="mujoco-usd is installed where it is tested")
    theirs, ours = mujoco.MjSpec.from_file(str(folder / "scene.usd")).compile(), exported().model()
    assert theirs.nq == ours.nq == 21
    for name in ("cone", "integrator", "impratio", "noslip_iterations", "timestep", "disableflags"):
        assert getattr(theirs.opt, name) == getattr(ours.opt, name), name
    data, their_data = mujoco.MjData(ours), mujoco.MjData(theirs)
    for model, state in ((ours, data), (theirs, their_data)):
        mujoco.mj_forward(model, state)
    assert their_data.ncon == data.ncon
    for name in NAMES:
        body, other = data.body(name), their_data.body(f"/World/{name}")
        np.testing.assert_allclose(other.xpos, body.xpos, atol=1e-7)
        np.testing.assert_allclose(other.xmat, body.xmat, atol=1e-7)
        np.testing.assert_allclose(other.xipos, body.xipos, atol=1e-7)
        assert theirs.body(f"/World/{name}").mass == pytest.approx(ours.body(name).mass, rel=1e-6)
        inertias = [np.sort(m.body(n).inertia) for m, n in ((theirs, f"/World/{name}"), (ours, name))]
        np.testing.assert_allclose(*inertias, rtol=1e-5)
        piece, geom = theirs.geom(f"/World/{name}/piece_00"), ours.geom(f"{name}_piece_00")
        np.testing.assert_allclose(piece.friction, geom.friction, rtol=1e-6)
        assert (piece.group[0], piece.condim[0]) == (3, 6)
    start = their_data.qpos.copy()
    mujoco.mj_step(theirs, their_data, 1000)
    assert np.abs(their_data.qpos - start).max() < 1e-4


@pytest.mark.slow
def test_nvidia_s_asset_validator_finds_no_failure(folder):
    """Run with omniverse-asset-validator 1.18 on usd-core 26.11."""
    validator = pytest.importorskip("omni.asset_validator", reason="installed where it is tested")
    issues = validator.ValidationEngine().validate(str(folder / "scene.usd")).issues()
    assert [str(issue) for issue in issues if issue.severity.name in ("ERROR", "FAILURE")] == []


@pytest.mark.slow
def test_usd_s_own_validators_find_nothing(folder):
    """Run with usd-core 26.11, which has 30; the wheel of 25.11 lacks what they load."""
    validation = pytest.importorskip("pxr.UsdValidation", reason="this usd-core has no validators")
    from pxr import Usd

    if Usd.GetVersion() < (0, 26):
        pytest.skip("the wheels of usd-core 25 lack what its validators load")
    registry = validation.ValidationRegistry()
    context = validation.ValidationContext(registry.GetOrLoadAllValidators())
    errors = context.Validate(Usd.Stage.Open(str(folder / "scene.usd")))
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in errors] == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_scene_rests_in_newton_s_importer_of_usd(folder):
    """Run with newton 1.8.0 and usd-core 26.11 on Warp's CPU backend, as docs/simulators.md says."""
    newton = pytest.importorskip("newton", reason="installed where it is tested")
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    resolvers = [newton.usd.SchemaResolverNewton(), newton.usd.SchemaResolverMjc()]
    builder.add_usd(str(folder / "scene.usd"), schema_resolvers=resolvers, load_visual_shapes=False)
    model, ours = builder.finalize(), exported().model()
    masses = dict(zip(model.body_label, model.body_mass.numpy().tolist(), strict=True))
    assert masses == pytest.approx({f"/World/{name}": ours.body(name).mass[0] for name in NAMES}, rel=1e-5)
    state, after = model.state(), model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    pipeline = newton.CollisionPipeline(model, broad_phase="explicit", reduce_contacts=False)
    contacts = pipeline.contacts()
    solver = newton.solvers.SolverMuJoCo(model, use_mujoco_contacts=False, nconmax=256, njmax=1536)
    assert (solver.mj_model.opt.cone, solver.mj_model.opt.impratio) == (ours.opt.cone, ours.opt.impratio)
    np.testing.assert_allclose(np.unique(solver.mj_model.geom_solref, axis=0), [ours.geom("obj_000_piece_00").solref])
    start = state.body_q.numpy()
    for _ in range(250):
        state.clear_forces()
        pipeline.collide(state, contacts)
        solver.step(state, after, None, contacts, ours.opt.timestep)
        state, after = after, state
    assert np.abs(state.body_q.numpy() - start).max() < 1e-3

"""Sizes that simulators allot: exact degrees of freedom, and room for twice the contacts of the first state."""

import mujoco
import pytest

from tableverse_factory.physics.simulate.sizes import count_near_pairs, measure_sizes


def boxes(*places: str) -> mujoco.MjModel:
    body = '<body pos="{}"><freejoint/><geom type="box" size="0.1 0.1 0.1" condim="6"/></body>'
    things = "".join(body.format(place) for place in places)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option cone="elliptic"/><worldbody><geom type="box" size="5 5 0.1" pos="0 0 -0.1"/>{things}'
        "</worldbody></mujoco>"
    )


@pytest.mark.parametrize(
    ("places", "pairs"),
    [(("0 0 0.5",), 0), (("0 0 0.0999",), 1), (("0 0 0.0999", "0 0 0.2998"), 2), (("0 0 0.0999", "1 0 0.0999"), 2)],
)
def test_near_pairs_are_those_whose_boxes_overlap(places, pairs):
    model = boxes(*places)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert count_near_pairs(model, data) == pairs


def test_a_scene_of_many_geoms_is_counted_in_blocks():
    model = boxes(*(f"{k % 30} {k // 30} 0.0999" for k in range(600)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert count_near_pairs(model, data) == sum(k % 30 < 6 and k // 30 < 6 for k in range(600)), "those on the table"


def test_sizes_hold_twice_what_the_first_state_needs():
    model = boxes(*(f"{k} 0 0.0999" for k in range(5)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sizes = measure_sizes(model)
    assert (sizes.nv, data.ncon, data.nefc) == (30, 20, 120)
    assert (sizes.nconmax, sizes.njmax) == (64, 256)
    assert measure_sizes(boxes("0 0 9")).njmax == 32, "room for a first contact"

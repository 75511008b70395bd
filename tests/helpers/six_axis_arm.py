"""An arm of six joints as somebody else would write it: degrees, classes, a mesh, a tendon, a control of 0 to 255."""

from pathlib import Path

import numpy as np
import trimesh

HOME = (0.0, np.deg2rad(10), np.deg2rad(100), 0.0, np.deg2rad(70), 0.0)
"""The gripper points down."""

_TEXT = """
<mujoco model="six axes">
  <compiler angle="degree" meshdir="assets" autolimits="true"/>
  <option integrator="implicit"/>
  <default>
    <default class="collision">
      <geom type="capsule" group="3"/>
      <joint armature="0.1" damping="1" axis="0 1 0" range="-150 150"/>
      <general dyntype="none" biastype="affine" ctrlrange="-2.6 2.6" forcerange="-90 90"
        gainprm="3000" biasprm="0 -3000 -150"/>
      <default class="finger">
        <joint axis="0 1 0" type="slide" range="0 0.03"/>
        <geom type="box" size="0.01 0.005 0.03" pos="0 0.005 0.03"/>
      </default>
    </default>
  </default>
  <asset>
    <mesh name="foot" file="foot.obj"/>
    <material name="red" rgba="0.7 0.1 0.1 1"/>
  </asset>
  <worldbody>
    <light name="top" pos="0 0 2" mode="trackcom"/>
    <body name="foot" childclass="collision">
      <geom type="mesh" mesh="foot"/>
      <geom type="mesh" mesh="foot" material="red" contype="0" conaffinity="0" group="2"/>
      <body name="turret" pos="0 0 0.1">
        <joint name="a" axis="0 0 1"/>
        <geom fromto="0 0 0.02 0 0 0.15" size="0.05" mass="3"/>
        <body name="upper" pos="0 0 0.2">
          <joint name="b"/>
          <geom fromto="0 0 0 0 0 0.3" size="0.04" mass="3"/>
          <body name="lower" pos="0 0 0.35">
            <joint name="c"/>
            <geom fromto="0 0 0.03 0 0 0.2" size="0.04" mass="2"/>
            <body name="forearm" pos="0 0 0.3">
              <joint name="d" axis="0 0 1"/>
              <geom fromto="0 0 0 0 0 0.01" size="0.035" mass="1"/>
              <body name="wrist" pos="0 0 0.02">
                <joint name="e"/>
                <geom fromto="0 0 0.03 0 0 0.05" size="0.03" mass="1"/>
                <body name="hand" pos="0 0 0.1">
                  <joint name="f" axis="0 0 1"/>
                  <geom type="box" size="0.03 0.06 0.02" pos="0 0 0.02" mass="0.5"/>
                  <!--TCP-->
                  <body name="left" pos="0 0 0.04">
                    <joint name="left" class="finger"/>
                    <geom class="finger" mass="0.05"/>
                  </body>
                  <body name="right" pos="0 0 0.04" quat="0 0 0 1">
                    <joint name="right" class="finger"/>
                    <geom class="finger" mass="0.05"/>
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact>
    <exclude body1="forearm" body2="hand"/>
    <exclude body1="left" body2="right"/>
  </contact>
  <tendon>
    <fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed>
  </tendon>
  <equality>
    <joint joint1="left" joint2="right" solimp="0.95 0.99 0.001" solref="0.005 1"/>
  </equality>
  <actuator>
    <general class="collision" name="a" joint="a"/>
    <general class="collision" name="b" joint="b"/>
    <general class="collision" name="c" joint="c"/>
    <general class="collision" name="d" joint="d"/>
    <general class="collision" name="e" joint="e"/>
    <general class="collision" name="f" joint="f"/>
    <general class="collision" name="grip" tendon="split" forcerange="-40 40" ctrlrange="0 255"
      gainprm="0.0117647058824 0 0" biasprm="0 -100 -10"/>
  </actuator>
  <custom><numeric name="max_velocity" data="2"/></custom>
  <keyframe><key name="home" qpos="HOME 0.03 0.03"/></keyframe>
</mujoco>
"""
_TCP = '<site name="tcp" pos="0 0 0.09"/>'


def six_axes(folder: Path, *changes: tuple[str, str], tcp: bool = True, name: str = "arm.xml") -> Path:
    """The file in its folder, with texts replaced by others."""
    text = _TEXT.replace("HOME", " ".join(f"{angle:.6f}" for angle in HOME))
    text = text.replace("<!--TCP-->", _TCP) if tcp else text
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    (folder / "assets").mkdir(parents=True, exist_ok=True)
    trimesh.creation.cylinder(0.09, 0.1).apply_translation((0, 0, 0.05)).export(folder / "assets" / "foot.obj")
    path = folder / name
    path.write_text(text)
    return path

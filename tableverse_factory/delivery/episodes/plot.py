"""Plot of a recording's joints and gripper over time, as a small SVG without foreign text and without styles.

Colors come from the page's style sheet by class, for light and dark pages: `.plot .j1` to `.j7` for joints, `.band` for
every second phase, `.axis`, `.grid`, `.open` (the gripper), `.told` (its command, dashed), and `.line` in the legend.
"""

import numpy as np

from schemas.trajectories import JointVector, Phase
from tableverse_factory.delivery.episodes.subtasks import SUBTASKS
from tableverse_factory.robotics.execution.arrays import Recording

WIDTH, HEIGHT = 640, 260
COLORS = 7
_LEFT, _RIGHT, _TOP = 38.0, 8.0, 27.0
_JOINTS, _GAP, _GRIPPER = 130.0, 14.0, 44.0
_POINTS = 100
_CHARACTER = 5.0  # width of a letter
_ROWS = (_TOP - 5.0, _TOP - 15.0)  # heights of phase names, which are often wider than their phase
_SWATCH, _SPACE = 12.0, 5.0  # length of a legend line, and the gap behind it (twice that behind a word)


def plot_svg(recording: Recording, closed: JointVector, opened: JointVector, max_opening_m: float) -> str:
    """Draw the plot as inline markup; `closed` and `opened` are positions of the fingers' joints, shape (f,)."""
    n_joints = recording.command.shape[1] - 1
    shown = np.unique(np.rint(np.linspace(0, len(recording) - 1, min(len(recording), _POINTS))).astype(int))
    end_s = max(float(recording.time_s[-1]), recording.step_s)
    across = _LEFT + recording.time_s[shown] / end_s * (WIDTH - _LEFT - _RIGHT)
    joints = recording.qpos[shown, :n_joints]
    span = opened - closed
    opening = (recording.qpos[shown, n_joints:] - closed) @ span / (span @ span) * max_opening_m
    low = float(np.floor(joints.min()))
    high = max(float(np.ceil(joints.max())), low + 1.0)
    top = _TOP + _JOINTS + _GAP
    parts = [
        f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="Joint angles and gripper opening over {end_s:.1f} seconds, by phase">',
        *_draw_bands(recording, end_s),
        *_draw_grid(low, high, max_opening_m, top),
    ]
    shares = [(f"j{joint % COLORS + 1}", (joints[:, joint] - low) / (high - low)) for joint in range(n_joints)]
    parts += [_draw_line(kind, across, share, _TOP, _JOINTS) for kind, share in shares]
    for kind, lengths in (("told", recording.command[shown, -1]), ("open", opening)):
        parts.append(_draw_line(kind, across, lengths / max_opening_m, top, _GRIPPER))
    return "".join([*parts, *_draw_time_axis(end_s, top + _GRIPPER), *_draw_legend(n_joints), "</svg>"])


def _draw_line(kind: str, across: np.ndarray, share: np.ndarray, top: float, height: float) -> str:
    down = top + height * (1.0 - np.clip(share, -0.1, 1.1))
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
    return f'<polyline class="{kind}" points="{points}"/>'


def _draw_bands(recording: Recording, end_s: float) -> list[str]:
    """Shade every second phase until the next begins, with all names above."""
    parts, wide = [], WIDTH - _LEFT - _RIGHT
    starts = [int(np.searchsorted(recording.phase, number)) for number in range(len(Phase) + 1)]
    times = [float(recording.time_s[min(start, len(recording) - 1)]) / end_s for start in starts]
    height = _JOINTS + _GAP + _GRIPPER
    taken = [0.0] * len(_ROWS)
    for number, phase in enumerate(Phase):
        x, width = _LEFT + times[number] * wide, (times[number + 1] - times[number]) * wide
        if starts[number] == starts[number + 1]:
            continue
        if number % 2 == 0 and width > 0.0:
            parts.append(f'<rect class="band" x="{x:.1f}" y="{_TOP}" width="{width:.1f}" height="{height}"/>')
        half = _CHARACTER * len(SUBTASKS[phase]) / 2
        middle = min(x + width / 2, WIDTH - half)
        row = next((row for row in range(len(_ROWS)) if taken[row] <= middle - half), int(np.argmin(taken)))
        middle = min(max(middle, taken[row] + half), WIDTH - half)
        taken[row] = middle + half + _SPACE
        parts.append(f'<text x="{middle:.1f}" y="{_ROWS[row]}" text-anchor="middle">{SUBTASKS[phase]}</text>')
    return parts


def _draw_legend(n_joints: int) -> list[str]:
    entries = [(f"j{joint % COLORS + 1}", f"{joint + 1}") for joint in range(n_joints)]
    parts, x, y = [], _LEFT, HEIGHT - 8.0
    for kind, word in (("", "joints"), *entries, ("open", "gripper"), ("told", "its command")):
        if kind:
            parts.append(f'<path class="line {kind}" d="M{x:.1f} {y - 3:.1f}h{_SWATCH}"/>')
            x += _SWATCH + _SPACE
        parts.append(f'<text x="{x:.1f}" y="{y:.1f}">{word}</text>')
        x += _CHARACTER * len(word) + 2 * _SPACE
    return parts


def _draw_grid(low: float, high: float, max_opening_m: float, top: float) -> list[str]:
    step = 1.0 if high - low <= 4.0 else 2.0
    values = np.arange(np.ceil(low / step) * step, high + 1e-9, step)
    lines = [(_TOP + _JOINTS * (1.0 - (value - low) / (high - low)), f"{value:.0f}") for value in values]
    lines += [(top + _GRIPPER, "0"), (top, f"{1000 * max_opening_m:.0f}")]
    parts = []
    for y, label in lines:
        parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y + 3:.1f}" text-anchor="end">{label.replace("-", "−")}</text>')
    middle_joints, middle_gripper = _TOP + _JOINTS / 2, top + _GRIPPER / 2
    for name, y in (("rad", middle_joints), ("mm", middle_gripper)):
        parts.append(f'<text x="9" y="{y:.1f}" text-anchor="middle" transform="rotate(-90 9 {y:.1f})">{name}</text>')
    return parts


def _draw_time_axis(end_s: float, bottom: float) -> list[str]:
    step = next((step for step in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0) if end_s / step <= 10.0), end_s)
    parts = [f'<path class="axis" d="M{_LEFT} {bottom}H{WIDTH - _RIGHT}"/>']
    for time in np.arange(0.0, end_s + 1e-6, step):
        x = _LEFT + time / end_s * (WIDTH - _LEFT - _RIGHT)
        label = f"{time:g}" + (" s" if time == 0.0 else "")
        parts.append(f'<text x="{x:.1f}" y="{bottom + 13:.1f}" text-anchor="middle">{label}</text>')
    return parts

"""Card of a LeRobot dataset, DEST/README.md: by it the Hub and `datasets.load_dataset` find the frames."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import yaml

from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.dataset.card_yaml import make_license_keys, name_size

_READING = """\
```python
from datasets import load_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

frames = load_dataset("PATH", split="train")  # states, actions, tasks; "episodes" as second argument: a row per episode
dataset = LeRobotDataset("OWNER/NAME", root="PATH")  # with pictures
```"""


def make_lerobot_card(robot: str, frames: int, episodes: Sequence[dict[str, Any]]) -> str:
    """Make the card as Markdown with the Hub's front matter; `episodes` are the rows of meta/episodes."""
    licences = Counter(episode["licence"] for episode in episodes)
    splits = Counter(episode["split"] for episode in episodes)
    head = {
        "pretty_name": "Pick and place on certified table-tops",
        **make_license_keys(licences),
        "size_categories": [name_size(frames)],
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "mujoco", "simulation", "table-top"],
        "configs": [
            {"config_name": "default", "data_files": "data/*/*.parquet"},
            {"config_name": "episodes", "data_files": "meta/episodes/*/*.parquet"},
        ],
    }
    scenes, solved = len({episode["scene_id"] for episode in episodes}), sum(e["success"] for e in episodes)
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---",
        "# Pick and place on certified table-tops",
        f"{pluralize(len(episodes), 'episode')} of the robot {sanitize_line(robot, 80)} on "
        f"{pluralize(scenes, 'scene')}, {frames} frames; successes: {solved}. Made by TableVerse Factory in MuJoCo, in "
        "the format of LeRobot v3.0.",
        "Episodes by split, each scene's from the hash of its picture: "
        + ", ".join(f"{name} {count}" for name, count in splits.items())
        + ".",
        "Licence of the scenes, by episodes: "
        + ", ".join(f"{sanitize_line(name, 60) or 'not stated'} {count}" for name, count in sorted(licences.items()))
        + ".",
        _READING,
    ]
    return "\n\n".join(parts) + "\n"

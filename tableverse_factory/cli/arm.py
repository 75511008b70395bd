"""Check of `--robot` against the robot of a dataset, before anything is written or replayed."""

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line


def check_robot_option(out: str, robot: str | None, needed: bool) -> None:
    """Refuse a robot that has no effect or differs from the dataset's, and a missing one whose file is `needed`."""
    from schemas.config import Config
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.robotics.robots.recorded import record_robot
    from tableverse_factory.robotics.robots.registry import ARMS

    run = open_dataset(out).record() or {}
    config = run.get("config")
    section = config.get("trajectories") if isinstance(config, dict) else None
    made_with = section.get("robot") if isinstance(section, dict) else None
    if not isinstance(made_with, str):
        return  # a dataset of another tool, whose arrays name their robot
    name = sanitize_line(made_with, 100)
    if robot is None:
        if needed and made_with.endswith(".xml"):
            raise InputError(f"{out}: its arm came from a file, {name}: give that file with --robot")
        return
    if made_with in ARMS and robot != made_with:
        raise InputError(f"--robot {sanitize_line(robot, 100)}: {out} was made with {name}, so leave --robot out")
    recorded = run.get("robot")
    if made_with.endswith(".xml") and recorded is not None:
        given = record_robot(Config.model_validate({"trajectories": {"robot": robot}}), {})
        if given != recorded:
            raise InputError(
                f"--robot {sanitize_line(robot, 100)}: not the arm that {out} was made with, {name}: a name or bytes "
                "among its files differ"
            )

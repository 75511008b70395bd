"""The page on trajectories explains every reason that a row can have, and none that no row has."""

import ast
import re
from typing import get_args, get_type_hints

import pytest

from tableverse_factory.core.config import list_keys
from tableverse_factory.stages.trajectories.fork_pool import ItemFailure
from tests.helpers.paths import ROOT

SECTION = "## Why a task has none"
FOLDERS = ("robotics/motion", "robotics/placements", "robotics/execution", "stages/trajectories")
PLACES = {"NoMotion": 1, "RolloutFailure": 1, "NoPlacement": 0, "PlannedTask": None, "Verdict": 2}
"""Where the reason stands among the arguments of what says it; None where it is named."""

LOST = "lost"
"""Said by the driver of a whole scene (`schemas.outcome.Failed`)."""

_CODE = re.compile(r"[a-z]+(_[a-z]+)*")


def section() -> str:
    return (ROOT / "docs" / "trajectories.md").read_text().split(SECTION)[1].split("\n## ")[0]


def explained() -> list[str]:
    return re.findall(r"^\| `(\w+)` \|", section(), re.MULTILINE)


def said() -> set[str]:
    """Constants that stand where a reason is said, or that a name which stands there is given in the same file."""
    found: set[str] = set()
    for folder in FOLDERS:
        for path in sorted((ROOT / "tableverse_factory" / folder).glob("*.py")):
            tree = ast.parse(path.read_text())
            for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
                found |= codes_of(reason_of(call), tree)
    return found


def reason_of(call: ast.Call) -> ast.expr | None:
    if not isinstance(call.func, ast.Name) or call.func.id not in PLACES:
        return None
    place = PLACES[call.func.id]
    by_name = next((keyword.value for keyword in call.keywords if keyword.arg == "reason"), None)
    return call.args[place] if place is not None and len(call.args) > place else by_name


def codes_of(reason: ast.expr | None, tree: ast.Module) -> set[str]:
    if isinstance(reason, ast.Name):
        given = [n.value for n in ast.walk(tree) if isinstance(n, ast.Assign) and reason.id in names_of(n)]
        return set().union(*(codes_of(value, tree) for value in given if not isinstance(value, ast.Name)))
    if isinstance(reason, ast.IfExp):
        return codes_of(reason.body, tree) | codes_of(reason.orelse, tree)
    constant = isinstance(reason, ast.Constant) and isinstance(reason.value, str) and _CODE.fullmatch(reason.value)
    return {reason.value} if constant else set()


def names_of(assignment: ast.Assign) -> set[str]:
    return {target.id for target in assignment.targets if isinstance(target, ast.Name)}


def test_every_reason_is_explained_once_and_no_other():
    perished = set(get_args(get_type_hints(ItemFailure)["kind"]))
    assert set(explained()) == said() | perished | {LOST}
    assert len(explained()) == len(set(explained()))
    assert len(said()) > 15


@pytest.mark.parametrize(
    "key", sorted(set(re.findall(r"(?:more|fewer|smaller|larger|lower|higher) `([a-z_.]+)`", section())))
)
def test_what_helps_can_be_set(key):
    assert {key, f"trajectories.{key}"} & set(list_keys())

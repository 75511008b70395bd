"""Instructions of tasks in words: foreign text made printable, and paraphrases of it."""

import re
from collections.abc import Mapping
from typing import Any

from schemas.curation import INSTRUCTION, Relation
from tableverse_factory.core.text import sanitize_line

_MAX_INSTRUCTION = 500
_RELATIONS = "|".join(sorted((re.escape(relation.value) for relation in Relation), key=len, reverse=True))
_PARTS = {"x": "(?P<x>.+)", "relation": f"(?P<relation>{_RELATIONS})", "y": "(?P<y>.+?)"}
_TEMPLATE = re.compile(rf"{INSTRUCTION.format_map(_PARTS)}\.?")
PARAPHRASES = (
    "Put {x} {relation} {y}",
    "Move {x} so that it is {relation} {y}",
    "Grasp {x}, carry it over and set it down {relation} {y}",
)


def read_instruction(row: Mapping[str, Any]) -> str:
    """Read the task's instruction: foreign text, cut and without control characters; empty for none."""
    return sanitize_line(str(row.get("instruction") or ""), _MAX_INSTRUCTION).strip()


def write_instruction(x: str, relation: Relation, y: str) -> str:
    """Write the instruction of a task as the factory words its own, from phrases such as *the red mug*."""
    return sanitize_line(INSTRUCTION.format(x=x, relation=relation.value, y=y), _MAX_INSTRUCTION)


def paraphrase_instruction(instruction: str) -> tuple[str, ...]:
    """Say an instruction of the usual template in three other ways; none of another template."""
    found = _TEMPLATE.fullmatch(instruction)
    return tuple(text.format_map(found.groupdict()) for text in PARAPHRASES) if found else ()

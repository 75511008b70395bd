"""Check of part G: a verdict for every task of an answer, with the reason for each refusal."""

import re

from schemas.curation import INSTRUCTION, GeneratedTask, JudgeAnswer, ObjectAssessment, Relation, TaskAssessment
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.lexicon import find_head_noun, is_generic, may_share_noun

MAX_INSTRUCTION_CHARS = 300
MAX_TASKS = 200  # most tasks of one answer; further ones are refused as `too_many`
_RELATIONS = {relation.value: relation for relation in Relation}
_TABLES = frozenset({"table", "tabletop", "desk", "countertop", "worktop"})


def check_tasks(
    answer: JudgeAnswer, case: JudgeInput, objects: tuple[ObjectAssessment, ...], source: str
) -> tuple[TaskAssessment, ...]:
    """Check every task of the answer, in its order; `source` is the judge's name, kept with each."""
    seen: set[tuple[int, str, int]] = set()
    tasks = []
    for number, task in enumerate(answer.generated_tasks):
        triple = (task.x_id, task.relation, task.y_id)
        early = "too_many" if number >= MAX_TASKS else "repeated" if triple in seen else ""
        refusal = early or _explain_refusal(task, case, objects)
        seen.add(triple)
        tasks.append(
            TaskAssessment(
                task_id=f"task_{number:03d}",
                instruction=_to_one_line(task.instruction),
                x_id=_find_object_id(task.x_id, case),
                y_id=_find_object_id(task.y_id, case),
                relation=_to_one_line(task.relation),
                source=source,
                accepted=not refusal,
                refusal=refusal,
            )
        )
    return tuple(tasks)


def _explain_refusal(task: GeneratedTask, case: JudgeInput, objects: tuple[ObjectAssessment, ...]) -> str:
    count = len(case.items)
    if not (0 <= task.x_id < count and 0 <= task.y_id < count):
        return "unknown_id"
    if task.x_id == task.y_id:
        return "same_object"
    if task.relation not in _RELATIONS:
        return "unknown_relation"
    if not fits_template(task):
        return "broken_template"
    heads = [_list_head_nouns(case.items[index].label, verdict) for index, verdict in enumerate(objects)]
    if _names_another(task.x_name, task.x_id, heads) or _names_another(task.y_name, task.y_id, heads):
        return "wrong_name"
    if _is_shared(task.x_name, objects) or _is_shared(task.y_name, objects):
        return "ambiguous_name"
    return case.feasibility.explain_refusal(_RELATIONS[task.relation], task.x_id, task.y_id, objects[task.x_id].mass_kg)


def fits_template(task: GeneratedTask) -> bool:
    """Whether the instruction is the paper's template with the task's own names; an article may precede them."""
    name_x, name_y = (re.escape(_strip_article(name)) for name in (task.x_name, task.y_name))
    article = "(?:the |a |an )?"
    pattern = INSTRUCTION.format(x=article + name_x, relation=re.escape(task.relation), y=article + name_y)
    return re.fullmatch(rf"{pattern}\.?", task.instruction, re.IGNORECASE) is not None


def _list_head_nouns(label: str, verdict: ObjectAssessment) -> frozenset[str]:
    names = (label, verdict.relabel_name, verdict.corrected_label, *verdict.distinguishing_phrases)
    return frozenset(find_head_noun(name) for name in names if name)


def _names_another(name: str, index: int, heads: list[frozenset[str]]) -> bool:
    """Whether a task's name for an object is the table's, or another object's and not its own."""
    head = find_head_noun(name)
    if is_generic(name) or any(may_share_noun(head, own) for own in heads[index]):
        return False
    others = (own for other, nouns in enumerate(heads) if other != index for own in nouns)
    return head in _TABLES or any(may_share_noun(head, own) for own in others)


def _is_shared(name: str, objects: tuple[ObjectAssessment, ...]) -> bool:
    bare = _strip_article(name).casefold()
    return sum(_strip_article(verdict.relabel_name).casefold() == bare for verdict in objects) > 1


def _strip_article(name: str) -> str:
    return re.sub(r"^(the|a|an) ", "", name, flags=re.IGNORECASE)


def _find_object_id(index: int, case: JudgeInput) -> str:
    """Find the object's id; the number as text where there is no such object."""
    return case.items[index].object_id if 0 <= index < len(case.items) else str(index)[:24]


def _to_one_line(text: str) -> str:
    printable = "".join(c if c.isprintable() else " " for c in text[:MAX_INSTRUCTION_CHARS])
    return " ".join(printable.split())

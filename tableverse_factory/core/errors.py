"""Every error raised on purpose.

TableverseError
├── InputError        a file or row is unusable: the message names the value and what would be right
├── ConfigError       an unknown key or a bad value: the message suggests the nearest
├── QueryError        an expression of `query --where`: the message points at the column
├── GeometryError     a mesh or point set beyond repair
├── SolverError       a numerical problem without an answer within its bounds: the caller takes another way
├── ModelError        a model backend that is missing or answers nonsense
│   ├── ModelAccessError    no key, a refused key, no credit: stops a build until a person acts
│   │   └── WeightsError    weights, or what loads them, that are missing, damaged or out of reach
│   ├── BudgetSpentError    the budget is spent: the scene waits, and the build ends
│   └── AnswerInvalidError  an unusable answer: the scene is dropped for its `reason`
└── BuildError        the build cannot go on or resume: the message says how to go on
    └── StoreError    an object store that refuses or does not answer; an OSError too, as a disk would raise
"""


class TableverseError(Exception):
    """Base of all errors: one clear line for the user, and `topic`, its anchor in docs/troubleshooting.md."""

    topic = "errors"

    def __init__(self, *args: object, topic: str | None = None) -> None:
        super().__init__(*args)
        if topic is not None:
            self.topic = topic


class _ReasonedError(TableverseError):
    """An error whose `reason` is its topic, unless it is the class's own."""

    reason = ""

    def __init__(self, message: str, reason: str = "", *, topic: str | None = None) -> None:
        super().__init__(message, topic=topic)
        if reason and reason != self.reason:
            self.reason = reason
            self.topic = topic or reason


class InputError(_ReasonedError):
    """A file or row that a user gave is unusable; `reason` is a stable snake_case code to count by."""

    topic = "bad-input"
    reason = "bad_input"


class ConfigError(TableverseError):
    """A key or a value of the configuration is wrong."""

    topic = "configuration"


class QueryError(TableverseError):
    """An expression of `query --where` does not parse or names no column."""

    topic = "query"


class GeometryError(TableverseError):
    """A mesh or point set is beyond repair."""

    topic = "bad-mesh"


class SolverError(TableverseError):
    """A numerical problem has no answer, or none within the work that was allowed."""

    topic = "solver"


class ModelError(TableverseError):
    """A model backend is missing, unreachable, or answers nonsense."""

    topic = "model-server"


class ModelAccessError(ModelError):
    """No model will answer before a person acts: no key, a refused key, no credit. Stops a build."""

    topic = "model-access"


class WeightsError(ModelAccessError):
    """Weights of a model, or what loads them, are missing, damaged or out of reach. Stops a build."""

    topic = "weights"


class BudgetSpentError(ModelError):
    """A question was not asked, because the budget is spent. Its scene is as it was before."""

    topic = "budget"


class AnswerInvalidError(_ReasonedError, ModelError):
    """A model gave no answer, or one beyond repair."""

    topic = "model-answer"
    reason = "answer_invalid"


class BuildError(TableverseError):
    """The build cannot go on or resume."""

    topic = "build"


class StoreError(BuildError, OSError):
    """An object store refuses, fails or does not answer, after all attempts."""

    topic = "object-store"

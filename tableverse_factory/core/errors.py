"""Every error that we raise on purpose.

TableverseError
├── InputError        a file or row that a user gave is unusable: says the value and what would be right
├── ConfigError       an unknown key, a bad value: suggests the nearest
├── QueryError        an expression of `query --where`: points at the column
├── GeometryError     a mesh or point set that no repair can save
├── SolverError       a numerical problem without an answer within its bounds: who asked goes another way
├── ModelError        a model backend that is missing or answers nonsense
│   ├── ModelAccessError    no key, a refused one, spent credit: nothing can go on before a person acts
│   ├── BudgetSpentError    nothing more may be spent on questions: the scene waits, and the build ends
│   └── AnswerInvalidError  an answer that is none: the scene is dropped for its `reason`
└── BuildError        the build cannot go on or resume: says how to go on
    └── StoreError    an object store that refuses or does not answer; an OSError too, as a disk would raise
"""


class TableverseError(Exception):
    """Base of all; its message is one clear line for the user, never a traceback."""


class InputError(TableverseError):
    """A file or row that a user gave is unusable.

    Attributes:
        reason: Stable snake_case code to count by, e.g. `depth_not_16_bit`.
    """

    def __init__(self, message: str, reason: str = "bad_input") -> None:
        super().__init__(message)
        self.reason = reason


class ConfigError(TableverseError):
    """A key or a value of the configuration is wrong."""


class QueryError(TableverseError):
    """An expression of `query --where` does not parse or name a column."""


class GeometryError(TableverseError):
    """A mesh or point set that no repair can save."""


class SolverError(TableverseError):
    """A numerical problem has no answer, or none within the work that was allowed."""


class ModelError(TableverseError):
    """A model backend is missing, unreachable, or answers nonsense."""


class ModelAccessError(ModelError):
    """No model will answer before a person acts: no key, a refused key, no credit. Stops a build."""


class BudgetSpentError(ModelError):
    """A question was not asked, because nothing more may be spent. Its scene is as it was before."""


class AnswerInvalidError(ModelError):
    """A model gave no answer, or one beyond repair.

    Attributes:
        reason: Stable snake_case code to count by.
    """

    def __init__(self, message: str, reason: str = "answer_invalid") -> None:
        super().__init__(message)
        self.reason = reason


class BuildError(TableverseError):
    """The build cannot go on or resume."""


class StoreError(BuildError, OSError):
    """An object store refuses, fails or does not answer, after all attempts."""

"""Instructions about any two objects, put together from the phrases that name them, on the device that trains."""

from tableverse_factory.evaluation.training.policy.packed_pictures import number_words
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

WORDS = 36  # of an instruction at most


class Wordings:
    """All wordings of all relations, without the phrases: words before X, between X and Y, and after Y, (n, 3, w)."""

    def __init__(self, parts: Tensor) -> None:
        self._before, self._between, self._after = parts.unbind(1)

    def compose(self, x: Tensor, y: Tensor) -> Tensor:
        """Compose random instructions about what two phrases name.

        Numbers of words: shapes (b, w) and (b, w); (b, `WORDS`).
        """
        which = torch.randint(len(self._before), (len(x),), device=x.device)
        words = torch.cat([self._before[which], x, self._between[which], y, self._after[which]], 1)
        return words.gather(1, (words == 0).to(torch.uint8).argsort(stable=True, dim=1))[:, :WORDS]


def number_instruction(instruction: str) -> Tensor:
    """Number the words of an instruction. Shape (1, `WORDS`)."""
    return torch.tensor(number_words(instruction, WORDS)[None].astype("int64"))

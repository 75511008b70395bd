"""Draws the curve of docs/policies.md: success on unseen pictures against the motions and scenes that were learnt.

`python docs/policy_curves.py RESULTS… FILE.png`, of policies named `sSCENESmMOTIONS_SEED`.
"""

import re
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot

from tableverse_factory.evaluation.benchmark.results import read_results


def main(results: list[Path], dest: Path) -> None:
    """Draw a point per training, and a line through the means of the same number of motions."""
    shares: dict[tuple[int, int], list[float]] = defaultdict(list)
    for path in results:
        header, rows = read_results(path)
        scenes, motions = map(int, re.fullmatch(r"s(\d+)m(\d+)_\d+", header.policy).groups())
        played = [row.success for row in rows.values() if row.split != "unseen_kinds" and row.axis == "none"]
        shares[motions, scenes].append(100 * sum(played) / len(played))
    figure, axes = pyplot.subplots(figsize=(5.6, 3.6), layout="constrained")
    for scenes in sorted({scenes for _, scenes in shares}):
        own = [(motions, share) for (motions, its), them in shares.items() if its == scenes for share in them]
        axes.plot(*zip(*own, strict=True), "o", label=f"{scenes} scenes")
    motions = sorted({motions for motions, _ in shares})
    means = [[share for (its, _), them in shares.items() if its == count for share in them] for count in motions]
    axes.plot(motions, [sum(them) / len(them) for them in means], color="0.6", zorder=0)
    axes.set(xscale="log", xlabel="motions learnt", ylabel="success on unseen pictures [%]", ylim=(0, 100))
    axes.set_xticks(motions, [str(count) for count in motions])
    axes.minorticks_off()
    axes.legend(frameon=False)
    figure.savefig(dest, dpi=120)


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:-1]], Path(sys.argv[-1]))

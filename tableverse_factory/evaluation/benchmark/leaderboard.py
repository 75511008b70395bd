"""Leaderboard: one page of HTML that opens from disk, of the scores of several policies; it escapes all texts."""

from jinja2 import Environment, PackageLoader, StrictUndefined

from tableverse_factory.core.version import __version__
from tableverse_factory.evaluation.benchmark.score import GROUP_NOTES, Score


def render_leaderboard(score: Score) -> bytes:
    """Render the page, the policy with most successes on unseen pictures first."""
    templates = Environment(
        loader=PackageLoader("tableverse_factory.evaluation.benchmark"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    unseen = next((row.rates for row in score.rows if (row.group, row.name) == ("split", "test")), ())
    shares = [0.0 if rate is None else rate.share for rate in unseen] or [0.0] * len(score.policies)
    page = templates.get_template("leaderboard.html").render(
        score=score,
        notes=GROUP_NOTES,
        names=name_policies(score),
        order=sorted(range(len(shares)), key=lambda index: -shares[index]),
        version=__version__,
    )
    return page.encode("utf-8", errors="backslashreplace")


def name_policies(score: Score) -> tuple[str, ...]:
    """Name the policies, those of one name with their digests."""
    names = [policy.policy for policy in score.policies]
    return tuple(
        name if names.count(name) == 1 else f"{name} {policy.policy_digest[:8]}"
        for name, policy in zip(names, score.policies, strict=True)
    )

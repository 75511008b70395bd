"""`tableverse doctor`: check of this machine."""

from pathlib import Path

import typer

from tableverse_factory.cli.options import AsJson
from tableverse_factory.cli.tables import print_json
from tableverse_factory.core.cache_dir import get_cache_dir


def doctor(as_json: AsJson = False) -> None:
    """Check this machine, and say what to do about what is missing.

    Checks rendering, system libraries, Ray, GPU, extras, cache and disk. Exit code 0 only if everything that a build
    needs is present.

    Example: `tableverse doctor`
    """
    from rich.console import Console
    from rich.text import Text

    from tableverse_factory.cli.doctor_checks import run_checks

    checks = []
    console = Console(soft_wrap=True, highlight=False)
    for check in run_checks(get_cache_dir(), Path.cwd()):
        checks.append(check)
        if not as_json:
            sign, style = ("✓", "green") if check.ok else ("✗", "red") if check.required else ("–", "yellow")
            console.print(Text.assemble((sign, style), f" {check.name}: {check.found}"))
            if check.advice:
                console.print(Text(f"    {check.advice}"))
    ready = all(check.ok for check in checks if check.required)
    if as_json:
        print_json({"ready": ready, "checks": checks})
    else:
        console.print("ready to build" if ready else "not ready: mend what has a ✗")
    raise typer.Exit(0 if ready else 1)

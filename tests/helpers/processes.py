"""Processes below a build, looked at while they come and go."""

import psutil


def command_of(process: psutil.Process) -> str:
    """Its command line; empty where it ended while we looked."""
    try:
        return " ".join(process.cmdline())
    except psutil.NoSuchProcess:
        return ""


def kill_if_alive(process: psutil.Process) -> bool:
    """Kills it; False where it ended while we looked."""
    try:
        process.kill()
    except psutil.NoSuchProcess:
        return False
    return True


def is_alive(process: psutil.Process) -> bool:
    """Whether it runs, or could."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False

"""TableVerse Factory: table-top pictures become simulation-ready, certified MuJoCo scenes."""

__version__ = "0.1.0"

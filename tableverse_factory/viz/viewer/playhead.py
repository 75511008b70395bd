"""Playback position of a recording."""


class Playhead:
    """A position `time_s` between the start and the end of a recording [s]."""

    def __init__(self, duration_s: float) -> None:
        self.duration_s = max(0.0, duration_s)
        self.time_s = 0.0
        self.playing = False

    def play(self) -> None:
        """Play on, from the end once more from the start."""
        if self.time_s >= self.duration_s:
            self.time_s = 0.0
        self.playing = True

    def pause(self) -> None:
        """Stop playing."""
        self.playing = False

    def seek(self, time_s: float) -> None:
        """Move to a position, clamped to the recording."""
        self.time_s = min(max(time_s, 0.0), self.duration_s)

    def advance(self, seconds: float) -> None:
        """Advance while playing; stop at the end."""
        if self.playing:
            self.seek(self.time_s + seconds)
            self.playing = self.time_s < self.duration_s

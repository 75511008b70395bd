"""Where in a recording one is, while it plays, stands, or is dragged to and fro."""


class Playhead:
    """A place between the start and the end of a recording.

    Attributes:
        duration_s: Of the recording [s].
        time_s: The place [s].
        playing: Whether time passes.
    """

    def __init__(self, duration_s: float) -> None:
        """Stands at the start.

        Args:
            duration_s: Of the recording [s].
        """
        self.duration_s = max(0.0, duration_s)
        self.time_s = 0.0
        self.playing = False

    def play(self) -> None:
        """Goes on; from the end, once more from the start."""
        if self.time_s >= self.duration_s:
            self.time_s = 0.0
        self.playing = True

    def pause(self) -> None:
        """Stays where it is."""
        self.playing = False

    def seek(self, time_s: float) -> None:
        """Goes to a place; beyond the ends there is none."""
        self.time_s = min(max(time_s, 0.0), self.duration_s)

    def advance(self, seconds: float) -> None:
        """Lets time pass if it plays; at the end it stops."""
        if self.playing:
            self.seek(self.time_s + seconds)
            self.playing = self.time_s < self.duration_s

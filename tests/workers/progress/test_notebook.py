"""Display of a build in a notebook, and the choice of a display."""

from tests.helpers.builds import Silent
from workers.progress.notebook import NotebookDisplay, open_display
from workers.progress.tally import Tally


class Cell:
    """The output of a notebook's cell."""

    def __init__(self):
        self.shown, self.updates = [], []

    def display(self, data, raw, display_id=False):
        assert raw
        self.shown.append(data["text/plain"])
        return self

    def update(self, data, raw):
        self.updates.append(data)


def test_a_notebook_shows_one_table_and_the_notes():
    cell = Cell()
    tally = Tally(("manifest", "look"), total=2, before=0, shards=1)
    with NotebookDisplay(cell.display) as display:
        display.note("starting \x1b[31mRay")
        tally.ended["look", "done"] = 1
        tally.record_call("look", 0.1, 0.1)
        display.show(tally)
    assert "preparing" in cell.shown[0]
    assert "\x1b" not in cell.shown[1]
    assert "1/2 scenes" in cell.updates[-1]["text/plain"]
    assert cell.updates[-1]["text/html"].startswith("<pre>")


def test_the_display_suits_the_place():
    silent = Silent()
    with open_display(silent) as shown:
        assert shown is silent
    with open_display(None) as shown:
        shown.note("nowhere")
    with open_display("auto") as shown:
        assert type(shown).__name__ == "ProgressDisplay"

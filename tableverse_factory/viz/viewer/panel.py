"""The controls of one browser; `session` connects them to actions."""

from typing import Any

from tableverse_factory.sources.textures.catalogue import FAMILIES
from tableverse_factory.viz.viewer.layouts import SETTLED
from tableverse_factory.viz.viewer.scene_index import ANY, STATUSES

NO_GHOST, AS_EXPORTED, NO_TASK, NO_MATCH = "none", "as exported", "no trajectory", "no scene found"
BACK, NEXT, PAGE_BACK, PAGE_NEXT = "‹", "›", "«", "»"
PLAY, PAUSE = "Play", "Pause"
_BRAND = (16, 84, 140)  # dark enough for white text on it

MAX_TEXTURE = 35  # largest number of a texture within its family


class Panel:
    """Handles of all controls of one client, from top to bottom."""

    def __init__(self, gui: Any) -> None:
        """Build the controls with the `viser.GuiApi` of the client."""
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", brand_color=_BRAND)
        gui.main_panel.dock_right()
        gui.set_panel_label("TableVerse")
        self.search = gui.add_text("Search", "", hint="Words of an id, a name, or a label of an object")
        self.status = gui.add_dropdown("Status", STATUSES, initial_value=ANY)
        self.scene = gui.add_dropdown("Scene", [NO_MATCH])
        self.step = gui.add_button_group("Go to", [PAGE_BACK, BACK, NEXT, PAGE_NEXT], hint="Scene or page, back or on")
        self.place = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Scene"):
            self.photograph = gui.add_html("")
            self.camera = gui.add_button("Picture's camera", hint="View from the camera of the photograph")
            self.facts = gui.add_html("")
        with tabs.add_tab("Show"):
            self.looks = gui.add_checkbox("Visual meshes", True)
            self.pieces = gui.add_checkbox("Collision pieces", False)
            self.contacts = gui.add_checkbox("Contacts", False, hint="Arrows along the normals, 30 mm per newton")
            self.names = gui.add_checkbox("Names", False)
            self.layout = gui.add_dropdown("Layout", [SETTLED])
            self.ghosts = gui.add_dropdown("Ghosts of", [NO_GHOST])
            self.texture = gui.add_dropdown("Table", [AS_EXPORTED, *FAMILIES])
            self.texture_number = gui.add_slider("Table no.", 0, MAX_TEXTURE, 1, 0)
            self.shown = gui.add_html("")
        with tabs.add_tab("Physics"):
            self.run = gui.add_button_group("Physics", [PLAY, PAUSE, "Reset"])
            self.speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
            self.target = gui.add_dropdown("Object", [NO_MATCH])
            self.push = gui.add_button_group(
                "Push", ["left", "right", "away", "up"], hint="Along x, y or z of the table"
            )
            self.strength = gui.add_slider("By [m/s]", 0.1, 3.0, 0.1, 0.8, hint="Change of speed")
            self.physics_status = gui.add_html("")
        with tabs.add_tab("Motion"):
            self.task = gui.add_dropdown("Task", [NO_TASK])
            self.play = gui.add_button_group("Motion", [PLAY, PAUSE])
            self.time = gui.add_slider("Time [s]", 0.0, 1.0, 0.01, 0.0)
            self.whole_arm = gui.add_button("Whole arm", hint="View that shows the whole arm")
            self.motion_status = gui.add_html("")

"""A plain client of a hub: list, open, draw, submit, arm, project in a dozen lines.

with Client("http://127.0.0.1:8017", "anna", password) as hub:
    case = hub.open_case("S26-1234")
    case.scan("before")
    with case.enter() as room:
        room.draw({"id": "cut-1", "camera": "camera1", "pixels": [[300, 200], [380, 230]], "width_mm": 0.8})
        version = room.wait(room.submit(), "checked")
        room.preview(version.number)
        room.start(room.arm(room.wait(version, "previewed")))  # only at the instrument itself
        ...
        room.stop()
"""

from fringescope.client.hub import Client, HubCase, HubError
from fringescope.client.room import HubVersion, Room
from fringescope.wire.record import content_of_stroke

__all__ = ["Client", "HubCase", "HubError", "HubVersion", "Room", "content_of_stroke"]

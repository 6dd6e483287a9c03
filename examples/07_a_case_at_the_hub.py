"""A case at the hub: an operator scans, an invited expert draws, the operator confirms, and light falls on the tissue.

    python examples/07_a_case_at_the_hub.py OUT [SCALE]

The hub runs in this program, on the simulated instrument, its data in OUT. Elsewhere it is `fringescope serve`, and
the two people are in two places; `fringescope.client` is the same. Needs the extra: pip install 'fringescope[server]'.
"""

import secrets
import sys
from pathlib import Path

from fringescope.client import Client
from fringescope.server.config import Config
from fringescope.server.running import Server
from fringescope.wire import PersonRole


def main(out: Path, scale: float = 0.125) -> None:
    password = secrets.token_urlsafe(12)
    config = Config(out, port=0, instrument=f"sim://paper/tissue-domed?scale={scale}&seed=2")
    with Server(config) as server:
        if not server.site.accounts.any():
            server.site.accounts.add("operator", password, PersonRole.OPERATOR)
        with Client(server.url, "operator", password) as here, Client(server.url) as afar:
            case = here.open_case("S26-1234", {"organ": "tongue", "pseudonym": "P-17"})
            print(f"the hub is at {server.url}; it scans (the first time ever takes minutes)", flush=True)
            scan = case.scan("as received").result
            assert scan is not None
            print(f"scan {scan['scan'][7:19]}: {len(case.scans()[0].files)} files")

            invited = case.invite("Dr. Far", "expert", hours=2)  # the link by mail, the code by telephone
            afar.accept(invited.token or "", invited.code or "")
            with case.enter() as operator, afar.case(case.id).enter() as expert:
                line = [[2000 * scale + 1000 * scale * t / 20, 1700 * scale] for t in range(21)]
                expert.draw({"id": "cut-1", "camera": "camera1", "pixels": line, "width_mm": 0.8, "color": "#ffffff"})
                expert.comment("along here, please", stroke="cut-1")
                version = expert.wait(expert.submit(), "checked")
                print(f"version {version.number} is checked: {'; '.join(version.problems) or 'all of it can be shown'}")

                operator.preview(version.number)
                version = operator.wait(version, "previewed")
                operator.start(operator.arm(version))
                shown = operator.until(lambda: next(operator.heard("evidence"), None), 60)
                (out / "projected.jpg").write_bytes(case.fetch(shown.payload["pictures"]["camera1.jpg"]))
                print(f"projected; the expert sees it, too: {expert.version(version.number).phase}")
                expert.stop("that is enough")
                print(f"{operator.wait(version, 'stopped').why.split(': ')[-1]}: dark")
            print(f"{len(case.events())} events in the log")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(str(__doc__))
    main(Path(sys.argv[1]), *(float(x) for x in sys.argv[2:3]))

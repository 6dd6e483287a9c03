"""The rules of the house, as tests: who may import whom, sizes, words that must not appear, docs that keep up."""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fringescope import cli, geometry, store
from fringescope.settings import describe
from fringescope.types import FringeSet, Reason

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "fringescope"
SOURCES = sorted(PACKAGE.rglob("*.py"))
DOCS = ROOT / "docs"

# ------------------------------------------------------------------------------------------------ who may import whom

DATA = {"types", "settings", "errors"}
BOTTOM = DATA | {"geometry", "kernels", "memory", "calm", "heights"}
STAGES = {
    "patterns", "phase", "denoise", "triangulate", "fuse", "response", "guide", "calibrate", "evaluate", "compare",
    "watch", "examination", "report", "register", "specimen",
}  # fmt: skip
ANYTHING = {"*"}

#: unit (module or package under fringescope) -> what it may import from us, and why. A new module needs a line here.
MAY_IMPORT: dict[str, tuple[set[str], str]] = {
    "errors": (set(), "the bottom"),
    "types": ({"errors"}, "data, no behaviour"),
    "settings": ({"errors"}, "data, no behaviour"),
    "jit": (set(), "kernels out of Numba's cache: knows nothing of what they do"),
    "threads": ({"jit"}, "rows on all cores: knows nothing of what the rows hold"),
    "gpu": ({"threads"}, "slabs of rows through a GPU: knows nothing of what the rows hold"),
    "memory": (set(), "large arrays used again: knows nothing of what they hold"),
    "kernels": ({"threads", "jit"}, "arrays in, arrays out: they know no dataclass, file or device"),
    "geometry": (DATA | {"kernels"}, "poses and lenses on top of the lens kernels"),
    "calm": (DATA | {"kernels", "threads", "memory"}, "tiles of an image that need no closer look, for any stage"),
    "heights": (DATA, "maps of height over a plane, for any stage"),
    **dict.fromkeys(STAGES, (BOTTOM, "stages never import each other: what passes between them is a type")),
    "twin": (DATA | {"threads", "jit"}, "the judge shares no maths with the judged"),
    "devices": (DATA, "a device knows what it is asked, not who asks"),
    "devices.simulated": (DATA | {"twin"}, "the twin posing as devices"),
    "devices.replay": (DATA | {"store"}, "a stored capture posing as devices"),
    "capture": (DATA | {"devices.base", "kernels"}, "the one stage that meets a device"),
    "store": (DATA, "files know data, not algorithms"),
    "importing": (DATA | {"store"}, "other people's images become one of our captures"),
    "export": (DATA, "files know data, not algorithms"),
    "pipeline": (
        BOTTOM | STAGES | {"capture", "devices.base", "threads", "gpu"},
        "all ordering lives here: objects, no files",
    ),
    "wire": (DATA, "what travels between hub, page and programs: types, no behaviour"),
    "client": (DATA | {"wire"}, "a program at the other end of the wire"),
    "server": (ANYTHING, "the rim: the command line alone imports it"),
    "bench": (ANYTHING, "times the whole, for the command line alone"),
    "warmup": (ANYTHING, "a tiny scan from end to end, for the command line alone"),
    "cli": (ANYTHING, "the rim: nobody imports it"),
    "__init__": (ANYTHING, "the front door: it re-exports the two doors of the Python API"),
    "__main__": (ANYTHING, "python -m fringescope"),
}
RIM = {"cli", "server", "__main__"}

#: (file, what it imports) -> why this one exception stands.
EXCEPTIONS: dict[tuple[str, str], str] = {}

#: Packages that only some units may import, and which.
CONFINED = {
    "numba": {"kernels", "jit", "gpu"},
    "typer": {"cli"},
    "rich": {"cli"},
    "matplotlib": {"report", "evaluate", "guide"},
    "embreex": {"twin"},
    "meshoptimizer": {"export"},
    "aiortc": {"server"},
    "av": {"server"},
    "tifffile": {"store"},
    "pydantic": {"store", "server", "wire", "client"},
    "httpx": {"client", "server"},
    "websockets": {"client"},
    "fastapi": {"server", "cli"},
    "sqlalchemy": {"server", "cli"},
    "socket": {"devices", "server", "cli"},
    "http": {"server", "cli"},
    "urllib": {"devices", "server"},
    "requests": set(),
    "pickle": {"jit"},
}


KERNELS_KNOW = {"numpy", "numba", "math", "__future__", "typing"}


def unit_of(path: Path) -> str:
    """`kernels`, `twin`, `devices.simulated`, `phase` ..: the finest name that the table knows."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    two = ".".join(parts[:2])
    return two if two in MAY_IMPORT else parts[0]


def imported(path: Path) -> Iterator[tuple[int, str]]:
    """Line and full dotted name of every import of a file, those in functions and under TYPE_CHECKING included."""
    package = ("fringescope", *path.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join((*above, node.module) if node.module else above)
            for alias in node.names:
                yield node.lineno, f"{base}.{alias.name}"


def target_unit(dotted: str) -> str:
    """The unit that a dotted name under fringescope lives in; `__init__` for what the front door re-exports."""
    parts = dotted.split(".")[1:]
    if not parts or not ((PACKAGE / parts[0]).is_dir() or (PACKAGE / f"{parts[0]}.py").exists()):
        return "__init__"
    two = ".".join(parts[:2])
    return two if len(parts) > 1 and (PACKAGE / parts[0] / f"{parts[1]}.py").exists() else parts[0]


def allowed(unit: str, target: str) -> bool:
    names = MAY_IMPORT[unit][0]
    own = target.split(".")[0] == unit.split(".")[0]
    return "*" in names or own or target in names or target.split(".")[0] in names


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports(path: Path) -> None:
    unit = unit_of(path)
    assert unit in MAY_IMPORT, f"{unit}: a new module needs a line in MAY_IMPORT (and in docs/architecture.md)"
    name = str(path.relative_to(PACKAGE))
    for line, dotted in imported(path):
        top = dotted.split(".")[0]
        if dotted == "fringescope.__version__":
            continue  # a word, no code
        if top == "fringescope":
            target = target_unit(dotted)
            if (name, target) in EXCEPTIONS:
                continue
            assert allowed(unit, target), f"{name}:{line} imports {target}; {unit}: {MAY_IMPORT[unit][1]}"
            assert target not in RIM or unit.split(".")[0] in RIM | {target}, f"{name}:{line}: nobody imports the rim"
        else:
            homes = CONFINED.get(top)
            assert homes is None or unit.split(".")[0] in homes, f"{name}:{line} imports {top}; only {homes} may"
            if unit == "kernels":
                assert top in KERNELS_KNOW, f"{name}:{line}: kernels know no {top}"


def test_the_import_rule_can_fail() -> None:
    assert not allowed("phase", "denoise")
    assert not allowed("twin", "geometry")
    assert not allowed("devices", "twin")
    assert not allowed("devices.replay", "twin.render")
    assert not allowed("store", "kernels.lens")
    assert not allowed("capture", "devices.simulated")
    assert allowed("devices.simulated", "twin.render")
    assert allowed("phase", "kernels.fringes")
    assert allowed("capture", "devices.base")
    assert target_unit("fringescope.kernels.lens.project_points") == "kernels.lens"
    assert target_unit("fringescope.types.Pose") == "types"
    assert target_unit("fringescope.scan") == "__init__"


def test_exceptions_are_used() -> None:
    found = {(str(p.relative_to(PACKAGE)), target_unit(d)) for p in SOURCES for _, d in imported(p)}
    assert set(EXCEPTIONS) <= found, "an exception that nobody needs any more"


# ----------------------------------------------------------------------------------------------------- inside a file


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_file_is_a_room_for_one_family(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= 500
    assert not re.search(r"\b(TODO|FIXME|XXX|raise NotImplementedError)\b", text)
    tree = ast.parse(text)
    assert ast.get_docstring(tree) or not text.strip(), "a module says in its first line what it is for"
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"line {node.lineno}: except without a type"
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            assert node.exc.func.id not in {"Exception", "BaseException"}, f"line {node.lineno}: raise from errors.py"
        if isinstance(node, ast.ImportFrom):
            assert all(a.name != "*" for a in node.names), f"line {node.lineno}: star import"
        if isinstance(node, ast.Global):
            raise AssertionError(f"line {node.lineno}: global state")


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_public_things_have_a_docstring(path: Path) -> None:
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, kinds) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{node.name} (line {node.lineno}) has no docstring"


# ------------------------------------------------------------------------------------------------- what is committed


def tracked() -> list[Path]:
    try:
        out = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout.decode()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [ROOT / name for name in out.split("\0") if name and (ROOT / name).is_file()]


def texts() -> Iterator[tuple[Path, str]]:
    for path in tracked():
        data = path.read_bytes()
        if b"\0" not in data[:4096]:
            yield path, data.decode("utf-8", errors="replace")


def test_no_registry_and_no_machine_in_a_file() -> None:
    hosts = ["py" + "pi.org", "python" + "hosted.org", "npm" + "js.org", "npm" + "js.com", "deb." + "debian.org"]
    homes = ["/" + "work/", "/" + "root/", "/" + "home/"]
    pattern = re.compile("|".join(re.escape(word) for word in hosts + homes))
    found = [f"{p.relative_to(ROOT)}: {m.group()}" for p, text in texts() for m in pattern.finditer(text)]
    assert not found


def test_no_large_files() -> None:
    sizes = {str(p.relative_to(ROOT)): p.stat().st_size for p in tracked()}
    assert not {name: size for name, size in sizes.items() if size > 1_500_000}


def test_every_dependency_is_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    core, extras = project["dependencies"], project["optional-dependencies"]
    dev = [*core, *extras["test"], *extras["docs"], *extras["dev"]]
    for name, wanted in (("core", core), ("dev", dev), ("gpu", [*core, *extras["gpu"]]),
                         ("meshopt", [*core, *extras["meshopt"]])):  # fmt: skip
        text = (ROOT / "constraints" / f"{name}.txt").read_text()
        pinned = {m.group(1).lower() for m in re.finditer(r"^([\w.-]+)==", text, re.M)}
        needed = {re.split(r"[\s\[<>=!~;]", d)[0].lower() for d in wanted} - {"fringescope"}
        assert needed <= pinned, f"constraints/{name}.txt lacks {needed - pinned}: make lock"
        assert "--hash=sha256:" in text
        assert "index-url" not in text


# ----------------------------------------------------------------------------------------------------- docs and code


def test_formats_page_names_every_reason() -> None:
    text = (DOCS / "formats.md").read_text()
    for reason in Reason:
        assert re.search(rf"\|\s*{reason.value}\s*\|\s*{re.escape(reason.label)}\s*\|", text), reason


def test_the_examples_on_the_formats_page_are_read(tmp_path: Path) -> None:
    blocks = re.findall(r"```json\n(.*?)```", (DOCS / "formats.md").read_text(), flags=re.S)
    examples = [json.loads(block) for block in blocks if block.count('{"pattern"') < 2]
    rig = next(e for e in examples if e.get("format") == "fringescope-rig")
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    read = store.read_rig(tmp_path / "rig.json")
    assert geometry.centre(read.cameras[0].pose) == pytest.approx([320, 0, 500], abs=0.1)
    assert geometry.centre(read.projector.pose) == pytest.approx([0, 0, 500])
    for d in read.devices:
        middle = [(d.lens.width - 1) / 2, (d.lens.height - 1) / 2]
        assert geometry.project(d, [0, 0, 0]) == pytest.approx(middle, abs=0.1)
    capture = next(e for e in examples if e.get("format") == "fringescope-capture")
    (tmp_path / "camera1").mkdir()
    for name in [*capture["views"][0]["sets"][0]["frames"], capture["views"][0]["color"]]:
        assert cv2.imwrite(str(tmp_path / name), np.zeros((4, 6), np.uint8))
    (tmp_path / "capture.json").write_text(json.dumps(capture))
    plan = store.read_capture(tmp_path).views[0].plan
    assert (plan.camera, plan.sets[0]) == ("camera1", FringeSet((0.0, 0.000877), 4))


@pytest.mark.parametrize("page", ["settings", "commands"])
def test_reference_pages_say_what_the_code_says(page: str) -> None:
    spec = importlib.util.spec_from_file_location("make_reference", ROOT / "tools" / "make_reference.py")
    assert spec is not None
    assert spec.loader is not None
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    there = (DOCS / "reference" / f"{page}.md").read_text()
    assert there == getattr(maker, f"{page}_page")(), "run: make reference"
    if page == "settings":
        for section, f, _ in describe():
            assert f"`{section}.{f.name}`" in there
    else:
        for verb in cli_verbs():
            assert f"\n## {verb}\n" in there


def cli_verbs() -> dict[str, set[str]]:
    """Every command with the options that it takes."""
    commands = cli.whole().commands
    return {name: {o for p in c.params for o in (*p.opts, *p.secondary_opts)} for name, c in commands.items()}


def test_commands_that_the_pages_tell_a_reader_to_type_exist() -> None:
    verbs = cli_verbs()
    told = 0
    for page in [ROOT / "README.md", *DOCS.glob("*.md")]:
        for line in re.findall(r"^(?:    )?fringescope (\w+.*)$", page.read_text(), re.M):
            words = line.split("#")[0].split()
            assert words[0] in verbs, f"{page.name}: fringescope {words[0]}"
            unknown = {w for w in words if w.startswith("--")} - verbs[words[0]]
            assert not unknown, f"{page.name}: fringescope {words[0]} takes no {unknown}"
            told += 1
    assert told >= 6


def test_every_docs_page_is_reached_and_every_link_leads_somewhere() -> None:
    pages = {p for p in DOCS.rglob("*.md") if "evidence" not in p.parts}
    linked = {DOCS / "index.md"}
    for page in pages | {ROOT / "README.md", ROOT / "CONTRIBUTING.md"}:
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
            if "://" not in target and not target.startswith("mailto:"):
                there = (page.parent / target).resolve()
                assert there.exists(), f"{page.relative_to(ROOT)} links {target}"
                linked.add(there)
    for block in re.findall(r"```\{toctree\}(.*?)```", (DOCS / "index.md").read_text(), flags=re.S):
        linked |= {(DOCS / f"{name.strip()}.md") for name in block.splitlines() if name.strip() and ":" not in name}
    assert pages <= linked, f"no way leads to {[str(p.relative_to(ROOT)) for p in pages - linked]}"


def test_paper_map_names_things_that_exist() -> None:
    text = (DOCS / "paper_map.md").read_text()
    for module, name in re.findall(r"`((?:\w+/)*\w+)\.py:(\w+)`", text):
        places = [PACKAGE / f"{module}.py", ROOT / f"{module}.py"]
        source = next((p.read_text() for p in places if p.exists()), None)
        assert source is not None, f"paper_map.md: no {module}.py"
        assert re.search(rf"\b(def|class) {name}\b|^{name}\b", source, re.M), f"paper_map.md: {module}.py has no {name}"
    for test in re.findall(r"`(tests/\S+?\.py)(?:::(\w+))?`", text):
        assert (ROOT / test[0]).exists(), f"paper_map.md: no {test[0]}"
        assert not test[1] or f"def {test[1]}" in (ROOT / test[0]).read_text(), f"paper_map.md: no {test}"


def test_reasons_are_distinct_bits() -> None:
    values = [r.value for r in Reason]
    assert values == [1 << i for i in range(len(values))]

"""Writes docs/reference/ from the code: settings, commands, and an index of the Python API.

    python tools/make_reference.py            writes what has changed
    python tools/make_reference.py --check    status 1 if a committed page is not what the code says
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fringescope.settings import Settings, describe

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "fringescope"
OUT = ROOT / "docs" / "reference"
HEAD = "| setting | default | unit | meaning | range | paper |"
COMMITTED = ("settings.md", "commands.md")


def _cell(text: Any) -> str:
    return str(text).replace("|", "\\|").replace("\n", " ").strip()


def _bounds(low: float | None, high: float | None) -> str:
    if low is None and high is None:
        return ""
    if high is None:
        return f"at least {low:g}"
    return f"at most {high:g}" if low is None else f"{low:g} to {high:g}"


def settings_page() -> str:
    """Every setting with its unit, default and range."""
    lines = [
        "# Settings",
        "",
        "Every threshold of the program, in one tree. Write what should differ into a YAML file, one block a section,",
        "and give it with `--settings FILE`; what is not named keeps its default. Every scan stores the whole tree.",
        "",
        "```yaml",
        "denoise:",
        "  min_modulation: 5",
        "```",
        "",
        "This page is made from `settings.py` by `make reference`.",
    ]
    current = ""
    sections = {name: type(getattr(Settings(), name)) for name, _, _ in describe()}
    for section, f, value in describe():
        if section != current:
            doc = (sections[section].__doc__ or "").strip().splitlines()[0]
            lines += ["", f"## {section}", "", doc, "", HEAD, "|---|---|---|---|---|---|"]
            current = section
        m = f.metadata
        shown = str(value).lower() if isinstance(value, bool) else value
        bounds = "" if isinstance(value, bool) else _bounds(m["low"], m["high"])
        row = (f"`{section}.{f.name}`", shown, m["unit"], m["doc"], bounds, m["paper"])
        lines.append("| " + " | ".join(_cell(x) for x in row) + " |")
    return "\n".join(lines) + "\n"


def _option(parameter: Any) -> tuple[str, str]:
    """How one parameter is written, and what it does."""
    names = ", ".join(f"`{n}`" for n in [*parameter.opts, *parameter.secondary_opts])
    if parameter.param_type_name == "argument":
        names = f"`{parameter.name.upper()}`"
    text = getattr(parameter, "help", "") or ""
    default = parameter.default
    if default is not None and default is not False and not callable(default) and parameter.param_type_name == "option":
        text += f" (default {default})"
    return names, text


def commands_page() -> str:
    """Every verb of the command line with its arguments and options."""
    from fringescope.cli import whole

    root = whole()
    lines = [
        "# Commands",
        "",
        "`fringescope COMMAND --help` says the same. Exit status: 0 done, 1 the work failed (one line says why),",
        "2 wrong usage.",
        "",
        "This page is made from `cli.py` by `make reference`.",
    ]
    for name, command in sorted(root.commands.items()):
        if command.hidden:
            continue
        help_text = "\n".join(line.strip() for line in (command.help or "").strip().splitlines())
        arguments = [p.name.upper() for p in command.params if p.param_type_name == "argument"]
        lines += ["", f"## {name}", "", f"    fringescope {' '.join([name, *arguments])} [options]", "", help_text]
        rows = [_option(p) for p in command.params if not getattr(p, "hidden", False) and p.name != "help"]
        if rows:
            lines += ["", "| | |", "|---|---|", *(f"| {_cell(a)} | {_cell(b)} |" for a, b in rows)]
    return "\n".join(lines) + "\n"


def _public(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            yield node


def api_page() -> str:
    """Every public function and class with its signature and the first paragraph of its docstring."""
    lines = ["# Python API", "", "Every public name, by module. The docstrings say the rest."]
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        module = ".".join(("fringescope", *(p for p in parts if p != "__init__")))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = list(_public(tree))
        if not nodes:
            continue
        lines += ["", f"## {module}", "", (ast.get_docstring(tree) or "").split("\n\n")[0].replace("\n", " ")]
        for node in nodes:
            doc = (ast.get_docstring(node) or "").split("\n\n")[0]
            if isinstance(node, ast.FunctionDef):
                returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
                head = f"{node.name}({ast.unparse(node.args)}){returns}"
            else:
                head = f"class {node.name}({', '.join(ast.unparse(b) for b in node.bases)})".replace("()", "")
            lines += ["", "```python", head, "```", "", doc]
    return "\n".join(lines) + "\n"


def main(check: bool) -> int:
    """Writes the pages, or compares the committed ones with the code."""
    OUT.mkdir(parents=True, exist_ok=True)
    pages = {"settings.md": settings_page, "commands.md": commands_page, "api.md": api_page}
    stale = 0
    for name, make in pages.items():
        path = OUT / name
        if check and name not in COMMITTED:
            continue
        text = make()
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        if check:
            print(f"docs/reference/{name} is not what the code says: make reference", file=sys.stderr)
            stale = 1
        else:
            path.write_text(text, encoding="utf-8")
            print(f"docs/reference/{name}")
    return stale


if __name__ == "__main__":
    sys.exit(main("--check" in sys.argv[1:]))

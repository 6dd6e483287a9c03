"""Writes frontend/src/wire.ts: the types of `fringescope.wire` for the page, from the models that the hub checks with.

python tools/make_typescript.py            writes what has changed
python tools/make_typescript.py --check    status 1 if the committed file is not what the models say
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter

from fringescope.wire import documents, ops, room

OUT = Path(__file__).resolve().parents[1] / "frontend" / "src" / "wire.ts"
HEAD = "// Made by tools/make_typescript.py from fringescope.wire; change it there.\n"


def models() -> dict[str, type[BaseModel]]:
    """Every model of the wire by its name; of two of one name the module leads."""
    found: dict[str, type[BaseModel]] = {}
    for module, prefix in ((documents, ""), (ops, "Op"), (room, "Room")):
        for name, value in vars(module).items():
            own = isinstance(value, type) and issubclass(value, BaseModel) and value.__module__ == module.__name__
            if own and not name.startswith("_"):
                found[name if name not in found else prefix + name] = value
    return found


def schemas() -> dict[str, Any]:
    """The JSON schema of each, and of the unions of messages, with references by those names."""
    out: dict[str, Any] = {}
    everything: dict[str, Any] = {n: TypeAdapter(m) for n, m in models().items()}
    everything |= {
        "WhatIsSaid": TypeAdapter(ops.Said),
        "FromClient": TypeAdapter(room.FromClient),
        "FromServer": TypeAdapter(room.FromServer),
    }
    per, whole = TypeAdapter.json_schemas(
        [(n, "serialization", a) for n, a in everything.items()], ref_template="#/$defs/{model}"
    )
    rename = {}
    for (name, _mode), schema in per.items():
        if "$ref" in schema:
            rename[schema["$ref"].rsplit("/", 1)[1]] = name
        else:
            out[name] = schema
    for key, schema in whole["$defs"].items():
        out[rename.get(key, key)] = schema
    text = json.dumps(out)
    for old, new in rename.items():
        text = text.replace(f'"#/$defs/{old}"', f'"#/$defs/={new}"')
    found: dict[str, Any] = json.loads(text.replace("#/$defs/=", "#/$defs/"))
    return found


def kind(schema: dict[str, Any]) -> str:
    """A schema as a TypeScript type."""
    if "$ref" in schema:
        return str(schema["$ref"].rsplit("/", 1)[1])
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return " | ".join(json.dumps(v) for v in schema["enum"])
    for union in ("anyOf", "oneOf"):
        if union in schema:
            return " | ".join(dict.fromkeys(kind(s) for s in schema[union]))
    match schema.get("type"):
        case "array":
            if "prefixItems" in schema:
                return f"[{', '.join(kind(s) for s in schema['prefixItems'])}]"
            inner = kind(schema.get("items", {}))
            return f"({inner})[]" if "|" in inner else f"{inner}[]"
        case "object":
            if "properties" in schema:
                return "{ " + "; ".join(fields(schema)) + " }"
            more = schema.get("additionalProperties", True)
            return f"Record<string, {kind(more) if isinstance(more, dict) else 'unknown'}>"
        case "string":
            return "string"
        case "integer" | "number":
            return "number"
        case "boolean":
            return "boolean"
        case "null":
            return "null"
    return "unknown"


def fields(schema: dict[str, Any]) -> list[str]:
    """The properties of an object; what has a default may be left away by who sends it."""
    needed = {k for k, v in schema["properties"].items() if k in schema.get("required", ()) and "default" not in v}
    tags = {k for k, v in schema["properties"].items() if "const" in v and k in ("kind", "type")}
    return [f"{k}{'' if k in needed | tags else '?'}: {kind(v)}" for k, v in schema["properties"].items()]


def typescript() -> str:
    """The whole file."""
    parts = [HEAD]
    for name, schema in sorted(schemas().items()):
        words = " ".join(str(schema.get("description", "")).split())
        doc = f"/** {words} */\n" if words else ""
        if schema.get("type") == "object" and "properties" in schema:
            body = "".join(f"  {f};\n" for f in fields(schema))
            parts.append(f"{doc}export interface {name} {{\n{body}}}\n")
        else:
            parts.append(f"{doc}export type {name} = {kind(schema)};\n")
    return "\n".join(parts)


def main() -> int:
    """Writes the file, or checks it."""
    text = typescript()
    there = OUT.read_text() if OUT.exists() else ""
    if "--check" in sys.argv:
        return int(there != text)
    if there != text:
        OUT.parent.mkdir(parents=True, exist_ok=True)
        OUT.write_text(text)
        print(OUT)
    return 0


if __name__ == "__main__":
    sys.exit(main())

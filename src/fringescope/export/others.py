"""Clouds and surfaces for other people's programs: STL, OBJ, PCD, 3MF, E57. Units: millimetres (E57: metres)."""

from __future__ import annotations

import struct
import uuid
import zipfile
from pathlib import Path

import numpy as np

from fringescope.errors import OutputError
from fringescope.export.glb import encode_picture
from fringescope.export.ply import Target, opened
from fringescope.types import U32, AnyArray, Cloud, Surface


def faces_of(surface: Surface) -> U32:
    """Triangles (m, 3) of all parts as indices of `Surface.vertices`. Raises OutputError if there are none."""
    parts = [part.vertex_index[part.faces] for part in surface.parts if len(part.faces)]
    if not parts:
        raise OutputError("a surface without triangles; nothing to export")
    return np.concatenate(parts).astype(np.uint32)


def write_stl(surface: Surface, target: Target) -> None:
    """Binary STL: triangles with their own normals, mm, no colour."""
    faces = faces_of(surface)
    corners = surface.vertices[faces].astype("<f4")
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    out = np.zeros(len(faces), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]))
    out["normal"], out["corners"] = normal, corners
    with opened(target) as f:
        f.write(b"fringescope surface, units mm".ljust(80) + struct.pack("<I", len(out)))
        f.write(out.tobytes())


def write_obj(surface: Surface, path: str | Path, quality: int = 95) -> tuple[Path, ...]:
    """Wavefront OBJ with its MTL and one JPEG per picture beside it, mm; returns the files written, the OBJ first."""
    path = Path(path)
    material = path.with_suffix(".mtl")
    files = [path, material]
    v = "\n".join("v {:.6g} {:.6g} {:.6g}".format(*p) for p in surface.vertices.tolist())
    n = "\n".join("vn {:.5f} {:.5f} {:.5f}".format(*p) for p in surface.normals.tolist())
    lines, materials, first = [f"# units mm\nmtllib {material.name}", v, n], [], 1
    for part in surface.parts:
        picture, _ = encode_picture(part.texture, quality)
        files.append(path.with_name(f"{path.stem}_view{part.view}.jpg"))
        files[-1].write_bytes(picture)
        materials.append(f"newmtl view{part.view}\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {files[-1].name}\n")
        lines.append("\n".join(f"vt {u:.6f} {1 - w:.6f}" for u, w in part.uv.tolist()))
        lines.append(f"usemtl view{part.view}")
        vertex, texture = part.vertex_index[part.faces] + 1, part.faces + first
        lines.append("\n".join(f"f {a}/{ta}/{a} {b}/{tb}/{b} {c}/{tc}/{c}" for (a, b, c), (ta, tb, tc)
                               in zip(vertex.tolist(), texture.tolist(), strict=True)))
        first += len(part.uv)
    material.write_text("\n".join(materials), encoding="ascii")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return tuple(files)


def write_pcd(cloud: Cloud, target: Target) -> None:
    """Binary PCD 0.7: x y z, packed rgb, normals, sigma, view; mm."""
    kind = np.dtype([("xyz", "<f4", 3), ("rgb", "<u4"), ("normal", "<f4", 3), ("sigma", "<f4"), ("view", "u1")])
    out = np.empty(len(cloud), kind)
    c = cloud.rgb.astype(np.uint32)
    out["xyz"], out["normal"], out["sigma"], out["view"] = cloud.xyz, cloud.normals, cloud.sigma, cloud.view
    out["rgb"] = c[:, 0] << 16 | c[:, 1] << 8 | c[:, 2]
    header = ("# .PCD v0.7, units mm\nVERSION 0.7\nFIELDS x y z rgb normal_x normal_y normal_z sigma view\n"
              "SIZE 4 4 4 4 4 4 4 4 1\nTYPE F F F U F F F F U\nCOUNT 1 1 1 1 1 1 1 1 1\n"
              f"WIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n")
    with opened(target) as f:
        f.write(header.encode("ascii"))
        f.write(out.tobytes())


def write_3mf(surface: Surface, target: Target) -> None:
    """3MF core: the triangles for printing, mm, no colour."""
    faces = faces_of(surface)
    v = "".join('<vertex x="{:.6g}" y="{:.6g}" z="{:.6g}"/>'.format(*p) for p in surface.vertices.tolist())
    t = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*p) for p in faces.tolist())
    xml = '<?xml version="1.0" encoding="UTF-8"?>\n'
    model = (f'{xml}<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
             f'<resources><object id="1" type="surface"><mesh><vertices>{v}</vertices><triangles>{t}</triangles></mesh>'
             '</object></resources><build><item objectid="1"/></build></model>')
    kinds = (f'{xml}<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
             '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
             '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>'
             '</Types>')
    relations = (f'{xml}<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
                 '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
                 'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>')
    with opened(target) as f, zipfile.ZipFile(f, "w", zipfile.ZIP_DEFLATED) as z:
        for name, text in (("[Content_Types].xml", kinds), ("_rels/.rels", relations), ("3D/3dmodel.model", model)):
            z.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), text, zipfile.ZIP_DEFLATED)


# ------------------------------------------------------------------------------------------------- E57 (ASTM E2807)

_PAGE = 1020  # payload of a 1024-byte page; the last four bytes hold its checksum


def _crc32c_table() -> U32:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(0x82F63B78), table >> 1).astype(np.uint32)
    return table


def _paged(data: bytes) -> bytes:
    """Logical bytes with a CRC-32C after every 1020 of them, big-endian, as ASTM E2807 lays out a file."""
    padded = np.frombuffer(data + b"\0" * (-len(data) % _PAGE), np.uint8).reshape(-1, _PAGE)
    table, crc = _crc32c_table(), np.full(len(padded), 0xFFFFFFFF, np.uint32)
    for column in padded.T:  # all pages at once, one byte of each per step
        crc = table[(crc ^ column) & 0xFF] ^ (crc >> 8)
    check = (crc ^ np.uint32(0xFFFFFFFF)).astype(">u4").view(np.uint8).reshape(-1, 4)
    return np.concatenate([padded, check], axis=1).tobytes()


def _physical(logical: int) -> int:
    return logical // _PAGE * 1024 + logical % _PAGE


def _packets(columns: list[AnyArray]) -> bytes:
    """Data packets of at most 64 KiB: the points of each packet column by column."""
    width = sum(c.dtype.itemsize for c in columns)
    most = (60_000 // width) // 8 * 8
    out = bytearray()
    for i in range(0, len(columns[0]), most):
        streams = [c[i : i + most].tobytes() for c in columns]
        body = struct.pack(f"<H{len(streams)}H", len(streams), *map(len, streams)) + b"".join(streams)
        size = 4 + len(body)
        body += b"\0" * (-size % 4)
        out += struct.pack("<BBH", 1, 0, 4 + len(body) - 1) + body
    return bytes(out)


def write_e57(cloud: Cloud, target: Target) -> None:
    """E57: points in metres (as the standard asks), colours, and the view as row index; for metrology programs.

    Raises OutputError for an empty cloud.
    """
    if not len(cloud):
        raise OutputError("an empty cloud; E57 needs at least one point")
    metres = (cloud.xyz.astype(np.float64) / 1000.0).astype("<f4")
    columns = [np.ascontiguousarray(metres[:, i]) for i in range(3)]
    columns += [np.ascontiguousarray(cloud.rgb[:, i]) for i in range(3)] + [np.ascontiguousarray(cloud.view)]
    packets = _packets(columns)
    start = 48  # the file header
    section = 32 + len(packets)
    head = struct.pack("<B7xQQQ", 1, section, _physical(start + 32), 0)
    low, high = metres.min(axis=0).tolist(), metres.max(axis=0).tolist()
    xml_start = start + section
    xml_start += -xml_start % 4
    xml = _e57_xml(len(cloud), low, high, _physical(start)).encode()
    logical = xml_start + len(xml)
    pages = -(-logical // _PAGE)
    header = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, pages * 1024, _physical(xml_start), len(xml), 1024)
    body = header + head + packets
    with opened(target) as f:
        f.write(_paged(body + b"\0" * (xml_start - len(body)) + xml))


def _e57_xml(count: int, low: list[float], high: list[float], offset: int) -> str:
    axes = "".join(f'<cartesian{a} type="Float" precision="single"/>' for a in "XYZ")
    colours = "".join(f'<color{c} type="Integer" minimum="0" maximum="255"/>' for c in ("Red", "Green", "Blue"))
    bounds = "".join(f'<{a}Minimum type="Float">{lo!r}</{a}Minimum><{a}Maximum type="Float">{hi!r}</{a}Maximum>'
                     for a, lo, hi in zip("xyz", low, high, strict=True))
    limits = "".join(f'<color{c}Minimum type="Integer">0</color{c}Minimum><color{c}Maximum type="Integer">255'
                     f'</color{c}Maximum>' for c in ("Red", "Green", "Blue"))
    name = uuid.uuid5(uuid.NAMESPACE_OID, f"fringescope {count} {low} {high}")
    return ('<?xml version="1.0" encoding="UTF-8"?>\n<e57Root type="Structure" '
            'xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0">'
            '<formatName type="String">ASTM E57 3D Imaging Data File</formatName>'
            f'<guid type="String">{{{name}}}</guid><versionMajor type="Integer">1</versionMajor>'
            '<versionMinor type="Integer">0</versionMinor><e57LibraryVersion type="String">fringescope'
            '</e57LibraryVersion><coordinateMetadata type="String"></coordinateMetadata>'
            '<data3D type="Vector" allowHeterogeneousChildren="1"><vectorChild type="Structure">'
            f'<guid type="String">{{{uuid.uuid5(name, "cloud")}}}</guid><name type="String">cloud</name>'
            f'<cartesianBounds type="Structure">{bounds}</cartesianBounds>'
            f'<colorLimits type="Structure">{limits}</colorLimits>'
            f'<points type="CompressedVector" fileOffset="{offset}" recordCount="{count}"><prototype type="Structure">'
            f'{axes}{colours}<rowIndex type="Integer" minimum="0" maximum="255"/></prototype>'
            '<codecs type="Vector" allowHeterogeneousChildren="1"></codecs></points></vectorChild></data3D>'
            '<images2D type="Vector" allowHeterogeneousChildren="1"></images2D></e57Root>')

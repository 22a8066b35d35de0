"""The XDMF sidecar: a small XML text that shows the frames to ParaView before 5.12 and to VisIt.

It points at the datasets of the frame files, so it costs nothing. XDMF version 2, ``3DCoRectMesh``:
dimensions, origin and spacing are all given in z, y, x order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape, quoteattr

from f2s_hpc.io import layout

if TYPE_CHECKING:
    from f2s_hpc.io.runs import FrameMeta


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(value) for value in values)


def _grid(frames: str, meta: FrameMeta) -> list[str]:
    """Return the lines of one frame's grid."""
    cells = meta.cells[::-1]
    points = _numbers([n + 1 for n in cells])
    head = '<DataItem Format="XML" NumberType="Float" Precision="8" Dimensions="3">'
    lines = [
        f'      <Grid Name="frame {meta.number}" GridType="Uniform">',
        f'        <Time Value="{meta.time_s!r}"/>',
        f'        <Topology TopologyType="3DCoRectMesh" Dimensions="{points}"/>',
        '        <Geometry GeometryType="ORIGIN_DXDYDZ">',
        f"          {head}{_numbers(meta.origin[::-1])}</DataItem>",
        f"          {head}{_numbers(meta.spacing[::-1])}</DataItem>",
        "        </Geometry>",
    ]
    for name, place in meta.locations.items():
        center = "Cell" if place == layout.CELL_DATA else "Node"
        dimensions = _numbers(cells) if place == layout.CELL_DATA else points
        source = escape(f"{frames}/{layout.frame_name(meta.number)}:/{layout.VTK_ROOT}/{place}/{name}")
        lines += [
            f'        <Attribute Name={quoteattr(name)} AttributeType="Scalar" Center="{center}">',
            (f'          <DataItem Format="HDF" NumberType="Float" Precision="4" Dimensions="{dimensions}">'
             f"{source}</DataItem>"),
            "        </Attribute>",
        ]
    return [*lines, "      </Grid>"]


def sidecar_text(frames: str, metas: Sequence[FrameMeta]) -> str:
    """Return the XDMF text of the frames ``metas``, in order, that lie in the folder ``frames`` beside it."""
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        '<Xdmf Version="2.0">',
        "  <Domain>",
        '    <Grid Name="deposit" GridType="Collection" CollectionType="Temporal">',
    ]
    for meta in metas:
        lines += _grid(frames, meta)
    return "\n".join([*lines, "    </Grid>", "  </Domain>", "</Xdmf>", ""])

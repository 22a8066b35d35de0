"""One self-contained HTML page about one or two runs: figures embedded, no network, nothing else to send along."""

from __future__ import annotations

import base64
import html
import pathlib
from collections.abc import Mapping, Sequence

import f2s_hpc
from f2s_hpc.report import facts
from f2s_hpc.report.measure import Measurements
from f2s_hpc.report.quantities import Table, depth_tables, tables

_STYLE = """
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1a1a1a; max-width: 70rem;
       margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem;
       border-bottom: 1px solid #d9d9d9; padding-bottom: .2rem; } h3 { font-size: 1rem; margin: 1rem 0 .3rem; }
p.lead { color: #555; margin-top: 0; } nav a { margin-right: .9rem; } .wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0 1rem; font-variant-numeric: tabular-nums; }
th, td { padding: .22rem .7rem; border-bottom: 1px solid #e6e6e6; text-align: right; }
th:first-child, td:first-child { text-align: left; } thead th { border-bottom: 2px solid #999; }
figure { margin: .8rem 0; flex: 1 1 22rem; } figcaption { color: #555; font-size: .9rem; }
img { max-width: 100%; height: auto; } .pair { display: flex; flex-wrap: wrap; gap: 1.2rem; align-items: flex-start; }
.stack figure { flex-basis: 100%; }
.finding { background: #eef5fa; border-left: 4px solid #0072b2; padding: .6rem 1rem; }
.note { background: #fdf3e7; border-left: 4px solid #d55e00; padding: .4rem 1rem; margin: .5rem 0; }
td.bar { width: 14rem; } td.bar span { display: inline-block; height: .8rem; background: #0072b2; }
summary { cursor: pointer; }
@media print { body { margin: 0; } h2 { break-after: avoid; } figure, table { break-inside: avoid; } }
"""

_CAPTIONS = {
    "particles": "Sizes of the particles put in: share of the volume in particles below a diameter.",
    "profile": "Profile across the track: mean height along it.",
    "height-map": "Surface height above the substrate top, seen from above.",
    "roughness": "One profile with its Gaussian mean line, and what is left: the roughness.",
    "pores": "The section as image analysis sees it.",
    "depth": "Distribution by volume in layers of the height. The dashed line is the substrate top.",
    "sections": "Vertical section inside the interface (volume fraction 0.5). The dashed line is the substrate top.",
    "boundaries": "Ridges of PEEQ taken as particle boundaries; numbered particles are measured.",
    "flattening": "Flattening ratios of the particles in sections, with linear fits and 90 % bands, as in Fig. 17 of "
                  "the paper.",
    "flattening-tracers": "Flattening ratios of every particle by its tracers, beside those of the particles in "
                          "sections.",
}


def _escape(text: object) -> str:
    return html.escape(str(text))


def _image(path: pathlib.Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return (f'<figure><img alt="{_escape(caption)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{_escape(caption)}</figcaption></figure>")


def _figures(name: str, drawn: Mapping[str, list[pathlib.Path]], labels: Sequence[str]) -> str:
    paths = drawn.get(name, [])
    named = [f"{label}. {_CAPTIONS[name]}" if len(paths) > 1 else _CAPTIONS[name] for label in labels[:len(paths)]]
    # three panels in a row would be too small to read at half the width of the page
    kind = "pair stack" if name == "sections" else "pair"
    return f'<div class="{kind}">{"".join(_image(p, c) for p, c in zip(paths, named))}</div>' if paths else ""


def _table(table: Table, title: bool = True) -> str:
    head = "".join(f"<th>{_escape(cell)}</th>" for cell in table.head)
    body = "".join("<tr>" + "".join(f"<td>{_escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    above = f"<h3>{_escape(table.title)}</h3>" if title else ""
    return f'{above}<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _ledger(table: Table) -> str:
    """Return the energy ledger, with a bar for each share of the first run."""
    head = "".join(f"<th>{_escape(cell)}</th>" for cell in table.head)
    rows = []
    for row in table.rows:
        try:
            share = min(max(float(row[2]), 0.0), 100.0)
        except ValueError:
            share = 0.0
        cells = "".join(f"<td>{_escape(cell)}</td>" for cell in row)
        rows.append(f'<tr>{cells}<td class="bar"><span style="width:{share:.1f}%"></span></td></tr>')
    return (f'<div class="wide"><table><thead><tr>{head}<th></th></tr></thead><tbody>{"".join(rows)}</tbody></table>'
            "</div>")


def build_page(runs: Sequence[tuple[str, Measurements]], drawn: Mapping[str, list[pathlib.Path]]) -> str:
    """Return the page about one or two measured runs (name, measurements); ``drawn``: figures by name (``draw_all``).

    Everything is inside: style, text, figures as base64. With two runs every table has a column for each and one for
    the difference of the second from the first, and the page says which of them flattens more.
    """
    labels = [label for label, _ in runs]
    by_group = {table.title.split()[0]: table for table in tables(runs)}
    parts = [("Finding", _finding(runs)), ("Scene", _table(facts.scene_table(runs), False)),
             ("Particles", _table(facts.particle_table(runs), False) + _figures("particles", drawn, labels))]
    for name, group, pictures in (
            ("Heights", "Height", ()), ("Profile and height map", "Profile", ("profile", "height-map")),
            ("Roughness", "Roughness", ("roughness",)), ("Porosity", "Porosity", ("pores",)),
            ("PEEQ, temperature and stress by depth", "State", ("depth",)), ("Sections", "", ("sections",)),
            ("Flattening", "Flattening", ("boundaries", "flattening")),
            ("Every particle", "Tracers:", ("flattening-tracers",))):
        if group == "Tracers:" and group not in by_group:
            continue
        content = (_table(by_group[group]) if group in by_group else "") + "".join(
            _figures(picture, drawn, labels) for picture in pictures)
        if group == "State":
            content += "<details><summary>In numbers, layer by layer</summary>" + "".join(
                map(_table, depth_tables(runs))) + "</details>"
        parts.append((name, content or "<p>Not measured; see the notes.</p>"))
    parts.append(("Hand-over between cycles", "".join(
        f"<p>{_escape(f'{label}: ' if label else '')}{_escape(facts.handover_text(m.handover))}</p>"
        for label, m in runs)))
    ledger = facts.energy_table(runs)
    parts.append(("Energy ledger", _ledger(ledger) if ledger.rows else "<p>The run has no cycle table.</p>"))
    parts.append(("Run time", _table(facts.cost_table(runs), False)))
    parts.append(("Notes", _notes(runs)))
    return _page(runs, parts)


def _page(runs: Sequence[tuple[str, Measurements]], parts: Sequence[tuple[str, str]]) -> str:
    titles = [m.deposit.scene.title for _, m in runs]
    title = titles[0] if len(set(titles)) == 1 else " against ".join(titles)
    if len(runs) == 2:
        title += f": {runs[0][0]} and {runs[1][0]}"
    anchors = [name.lower().replace(",", "").replace(" ", "-") for name, _ in parts]
    links = "".join(f'<a href="#{anchor}">{_escape(name)}</a>' for anchor, (name, _) in zip(anchors, parts))
    body = "".join(f'<section id="{anchor}"><h2>{_escape(name)}</h2>{content}</section>'
                   for anchor, (name, content) in zip(anchors, parts) if content)
    return ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{_escape(title)}</title><style>{_STYLE}</style></head><body><h1>{_escape(title)}</h1>"
            f'<p class="lead">{_escape(facts.subtitle(runs))}; f2s_hpc {_escape(f2s_hpc.__version__)}</p>'
            f"<nav>{links}</nav>{body}</body></html>\n")


def _finding(runs: Sequence[tuple[str, Measurements]]) -> str:
    return "".join(f'<p class="finding">{_escape(text)}</p>' for text in facts.findings(runs))


def _notes(runs: Sequence[tuple[str, Measurements]]) -> str:
    methods = [*facts.METHODS, *([facts.TRACER_METHOD] if any(m.traced for _, m in runs) else [])]
    own = [f"{label + ': ' if label else ''}{note}" for label, m in runs for note in m.notes]
    return ("".join(f'<p class="note">{_escape(note)}</p>' for note in dict.fromkeys(own))
            + "".join(f"<p>{_escape(text)}</p>" for text in methods))

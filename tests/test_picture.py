"""The picture at the end of a run, and the cycle table."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread

from f2s_hpc.analysis import picture
from f2s_hpc.analysis.surface import attached_material, landed_surface
from f2s_hpc.analysis.table import COLUMNS, format_table
from f2s_hpc.errors import F2SError, InputError

UM = 1e-6
# name: cells (nx, ny, nz), cell size, substrate height, deposit height
BOXES = {
    "quick start": ((20, 20, 50), 6 * UM, 48 * UM, 90 * UM),
    "paper": ((35, 35, 60), 10 * UM, 50 * UM, 330 * UM),
    "first cycle": ((35, 35, 60), 10 * UM, 50 * UM, 35 * UM),
    "2 mm tall": ((35, 35, 200), 10 * UM, 50 * UM, 350 * UM),
    "2 mm tall, full": ((35, 35, 200), 10 * UM, 50 * UM, 1800 * UM),
    "strip": ((355, 30, 40), 10 * UM, 50 * UM, 200 * UM),
    "strip along y": ((30, 355, 40), 10 * UM, 50 * UM, 200 * UM),
    "thick substrate": ((30, 30, 60), 10 * UM, 400 * UM, 80 * UM),
    "rectangle": ((60, 30, 30), 10 * UM, 50 * UM, 100 * UM),
}


def deposit(cells, dx, substrate, height, splats=None):
    """Return fields of a substrate under flattened ellipsoids, hot and strained at their rims, and one in flight."""
    rng = np.random.Generator(np.random.PCG64(7))
    nx, ny, nz = cells
    z, y, x = (dx * (np.arange(n) + 0.5) for n in (nz, ny, nx))
    fraction = np.repeat(np.clip((substrate - z) / dx + 0.5, 0.0, 1.0), ny * nx).reshape(nz, ny, nx)
    depth = np.maximum(substrate - z, 0.0)[:, None, None]
    peeq = np.exp(-depth / 15e-6) * (fraction > 0.0)
    temperature = (298.0 + 150.0 * np.exp(-depth / 25e-6)) * (fraction > 0.0)
    speed = np.zeros_like(fraction)
    wide, flat = 22e-6, 10e-6
    if splats is None:
        count = int(height * nx * ny * dx**2 / (4.0 / 3.0 * np.pi * wide**2 * flat))
        splats = [(rng.uniform(0, nx * dx), rng.uniform(0, ny * dx), substrate + height * (n + 0.5) / count, 0.0)
                  for n in range(count)]
        splats.append((nx * dx / 2, ny * dx / 2, nz * dx - 2 * flat, 615.0))
    for cx, cy, cz, v in splats:
        part = tuple(slice(max(int((c - a) / dx) - 1, 0), int((c + a) / dx) + 2)
                     for c, a in ((cz, flat), (cy, wide), (cx, wide)))
        d = np.sqrt(((z[part[0]] - cz) / flat)[:, None, None] ** 2 + ((y[part[1]] - cy) / wide)[:, None] ** 2
                    + ((x[part[2]] - cx) / wide) ** 2)
        fill = np.clip((1.0 - d) * flat / dx + 0.5, 0.0, 1.0)
        new = fill > fraction[part]
        for field, values in ((peeq, 0.5 + 2.0 * d**3), (temperature, 480.0 + 150.0 * d), (speed, v)):
            field[part] = np.where(new, values, field[part])
        fraction[part] = np.maximum(fraction[part], fill)
    fields = {"volume_fraction": fraction, "peeq": peeq, "temperature": temperature, "speed": speed}
    return {name: field.astype(np.float32) for name, field in fields.items()}


@pytest.fixture
def figure_of(monkeypatch):
    """Return a function that draws, and gives back the figure as well; without a path no file is written."""
    def draw(fields, dx, substrate, title="Title", subtitle="Subtitle", path=None):
        kept = []
        with monkeypatch.context() as patch:
            patch.setattr(picture, "save", lambda figure, *where: kept.append((figure, *where)))
            picture.draw(fields, dx, substrate, title, subtitle, path or "none")
        figure, *where = kept[0]
        if path:
            picture.save(figure, *where)
        return figure

    return draw


@pytest.mark.parametrize("name", BOXES)
def test_every_shape_of_box_is_drawn_clearly(name, figure_of, tmp_path):
    """The file is a picture, nothing in it overlaps or is cut off, and no panel is a thin strip.

    Fails when a margin of the layout is too small for the text in it (try ``_LEFT = 0.3``)."""
    cells, dx, substrate, height = BOXES[name]
    path = tmp_path / "deposit.png"
    figure = figure_of(deposit(cells, dx, substrate, height), dx, substrate, "A long title " * 20, "subtitle " * 60,
                       path)
    pixels = imread(path)[..., :3]
    assert 1200 <= pixels.shape[1] <= 1600
    assert 700 <= pixels.shape[0] <= 1320
    assert np.unique((pixels * 255).astype(int) @ [65536, 256, 1]).size > 300
    assert 0.2 < np.mean(pixels.min(axis=2) > 0.99) < 0.95
    assert [p.name for p in tmp_path.iterdir()] == ["deposit.png"]
    renderer = FigureCanvasAgg(figure).get_renderer()
    things = [axes.get_tightbbox(renderer) for axes in figure.axes]
    things += [text.get_window_extent(renderer) for text in figure.texts]
    things += [legend.get_window_extent(renderer) for legend in figure.legends]
    for box in things:
        assert box.x0 >= 0.0
        assert box.y0 >= 0.0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
    for one, other in itertools.combinations(things, 2):
        across, up = min(one.x1, other.x1) - max(one.x0, other.x0), min(one.y1, other.y1) - max(one.y0, other.y0)
        assert min(across, up) <= 1.0, (one, other)
    for axes in panels(figure):
        box = axes.get_window_extent(renderer)
        assert min(box.width, box.height) >= 100
        # equal aspect: as many pixels per um upwards as along
        along, up = (np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim()))
        assert box.width / along == pytest.approx(box.height / up, rel=1e-6)


def panels(figure):
    """Return the axes of the two sections and the map, not those of the colour bars."""
    found = [axes for axes in figure.axes if axes.get_xlabel()]
    assert len(found) == 3
    return found


def test_the_panels_show_the_fields_in_their_units(figure_of):
    """Fails when the temperature stays in kelvin, or z is not counted from the substrate top."""
    cells, dx, substrate, height = BOXES["paper"]
    fields = deposit(cells, dx, substrate, height)
    strain, heat, top = (axes.images[0] for axes in panels(figure_of(fields, dx, substrate)))
    material = fields["volume_fraction"][:, 17, :][:strain.get_array().shape[0]] >= 0.5
    up = material.shape[0]
    for image, values in ((strain, fields["peeq"]), (heat, fields["temperature"] - 273.15)):
        shown = values[:up, 17, :][material]
        np.testing.assert_array_equal(image.get_array()[material], shown)
        assert image.get_clim() == pytest.approx(np.percentile(shown, [1, 99]), rel=1e-6)
        assert image.get_extent() == pytest.approx([0.0, 350.0, -50.0, up * 10.0 - 50.0])
    assert 330.0 < top.get_array().max() < 370.0  # not the particle in flight, at 520 um
    assert 380.0 <= up * 10.0 < 450.0  # the view ends a little above the deposit


def test_a_particle_on_a_symmetry_side_is_cut_where_it_is(figure_of):
    """Fails when the section is always the middle one."""
    fields = deposit((16, 16, 28), 3 * UM, 42 * UM, 10 * UM, splats=[(0.0, 0.0, 48 * UM, 0.0)])
    assert fields["volume_fraction"][15:, 8].max() == 0.0
    figure = figure_of(fields, 3 * UM, 42 * UM)
    strain, _, height = panels(figure)
    assert strain.images[0].get_array().max() > 1.5
    assert height.lines[-1].get_ydata() == pytest.approx([1.5, 1.5])
    assert "$y$ = 1.5 µm" in figure.legends[0].get_texts()[2].get_text()


def test_a_strip_along_y_is_cut_along_y(figure_of):
    cells, dx, substrate, height = BOXES["strip along y"]
    strain, _, top = panels(figure_of(deposit(cells, dx, substrate, height), dx, substrate))
    assert strain.get_xlabel() == top.get_xlabel() == "$y$ (µm)"
    assert top.get_xlim() == pytest.approx((0.0, 3550.0))
    assert top.lines[-1].get_xdata() == pytest.approx(strain.get_xlim())


@pytest.mark.parametrize("case", ["void", "bare substrate", "NaN"])
def test_a_box_without_a_deposit_can_be_drawn(case, tmp_path):
    fields = deposit((12, 12, 12), 5 * UM, 30 * UM, 0.0, splats=[])
    if case == "void":
        fields = {name: np.zeros_like(field) for name, field in fields.items()}
    if case == "NaN":
        fields["temperature"][3, 6, 6] = np.nan
    picture.draw(fields, 5 * UM, 30 * UM, "50 $ of copper", "", tmp_path / "a.png")
    assert imread(tmp_path / "a.png").std() > 0.01


def test_the_same_input_gives_the_same_bytes(tmp_path):
    cells, dx, substrate, height = BOXES["quick start"]
    for name in ("a.png", "b.png"):
        picture.draw(deposit(cells, dx, substrate, height), dx, substrate, "Title", "subtitle", tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_what_is_seen_does_not_depend_on_the_slabs(monkeypatch, rng):
    """Rubble in a tall box and fast cells: as for the whole box at once.

    Fails when ``survey`` leaves out the skin, or takes all that is slow for skin.
    """
    shape = (40, 23, 9)
    fraction = (rng.random(shape) * np.linspace(1.7, 0.3, 40)[:, None, None]).clip(0.0, 1.0).astype(np.float32)
    speed = (rng.random(shape) * 60.0).astype(np.float32)
    monkeypatch.setattr(picture, "ROWS_AT_ONCE", 4)
    found, amount, filled = picture.survey({"volume_fraction": fraction, "speed": speed}, UM, 3 * UM, 50.0)
    assert np.array_equal(found, landed_surface(fraction, attached_material(fraction, speed < 50.0), UM))
    assert np.unique(found).size > 100
    assert np.array_equal(amount, fraction[3:].sum(axis=0, dtype=np.float64))
    assert np.array_equal(filled, (fraction >= 0.5).any(axis=(1, 2)))


def test_bad_input_is_one_line(tmp_path):
    fields = deposit((12, 12, 12), 5 * UM, 30 * UM, 0.0, splats=[])
    with pytest.raises(F2SError, match="cannot be written"):
        picture.draw(fields, 5 * UM, 30 * UM, "", "", tmp_path / "missing" / "a.png")
    with pytest.raises(InputError, match=r"'peeq' has shape \(12, 12, 6\)"):
        picture.draw(fields | {"peeq": fields["peeq"][..., :6]}, 5 * UM, 30 * UM, "", "", tmp_path / "a.png")
    del fields["speed"]
    with pytest.raises(InputError, match=r"no field 'speed'; output\.fields must hold"):
        picture.draw(fields, 5 * UM, 30 * UM, "", "", tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


ROW = {"cycle": "10", "time_s": "3.525e-06", "steps": "123456", "dt_s": "2.1234e-10", "dt_limit": "end of cycle",
       "particles": "5000", "dense_height_m": "0.0003346", "height_mean_m": "0.00034812", "height_p95_m": "0.00035",
       "height_max_m": "0.00035274", "peeq_p50": "1.234", "peeq_p95": "3.456", "peeq_max": "7.891",
       "temperature_p50_degC": "312.4", "temperature_p95_degC": "498.6", "mass_drift_relative": "-1.234e-14",
       "numerical_loss_fraction": "0.1234", "active_cells": "2737800", "active_cell_steps_per_s": "123456789.0",
       "imbalance": "1.04", "peak_memory_bytes_per_rank": "1073741824", "wall_s": "12.0"}


def test_the_table_has_every_column_in_its_unit_and_fits_a_terminal():
    """Fails when a scale of ``COLUMNS`` is wrong."""
    assert set(ROW) - {"wall_s"} == {column.key for column in COLUMNS}
    lines = format_table([ROW | {"cycle": "9", "peeq_p50": ""}, ROW]).splitlines()
    assert len(lines) == 6
    assert max(map(len, lines)) <= 160
    assert lines[-1].split() == [
        "10", "3.525", "123456", "212.3", "end", "of", "cycle", "5000", "334.6", "348.1", "350.0", "352.7", "1.23",
        "3.46", "7.89", "312", "499", "-1.2e-14", "12.3", "2737.8", "123.46", "1.04", "1024"]
    assert lines[-2].split()[0] == "9"
    assert "-" in lines[-2].split()
    assert "height above substrate" in lines[0]
    for words in ("cycle time steps dt limit", "dense mean p95 max p50 p95 max p50 p95 mass"):
        assert words in " ".join(lines[1].split())
    assert lines[2].split() == ["us", "ps", *["um"] * 4, "degC", "degC", "drift", "%", "kcells", "steps/s",
                                "ance", "MiB"]


def test_numbers_stand_under_their_headers():
    lines = format_table([ROW]).splitlines()
    rule, body = lines[3], lines[4]
    ends = [n for n, letter in enumerate(rule) if letter == "-" and rule[n + 1:n + 2] != "-"]
    starts = [0] + [end + 1 for end in ends[:-1]]
    cells = [body[a:b + 1].strip() for a, b in zip(starts, ends)]
    assert cells[3:6] == ["212.3", "end of cycle", "5000"]
    assert len(cells) == len(COLUMNS)


def test_missing_columns_are_left_out_and_numbers_may_be_numbers():
    text = format_table([{"cycle": 1, "time_s": 1e-6, "peeq_p50": None}, {"cycle": 2, "time_s": 2e-6, "peeq_p50": 0.5}])
    lines = text.splitlines()
    assert [line.split() for line in lines[-2:]] == [["1", "1.000", "-"], ["2", "2.000", "0.50"]]
    assert "degC" not in text
    assert "dt" not in text


def test_a_damaged_or_empty_table_says_so():
    assert format_table([]) == "no cycle has finished yet"
    with pytest.raises(InputError, match="row 2, time_s: 'abc' is not a number"):
        format_table([ROW, ROW | {"time_s": "abc"}])
    with pytest.raises(InputError, match=r"summary\.csv"):
        format_table([{"a": "1"}])

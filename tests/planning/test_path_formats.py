"""Tables of paths as other programs write them, numbers in other units, and what is refused before work is done."""

from __future__ import annotations

import io
import logging
import zipfile
from math import pi
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import make, refusal
from test_path_file import LENGTH, loop, options, save

from multilift_marl.errors import warn_once
from multilift_marl.planning import path_table
from multilift_marl.planning.path_file import MAX_ROWS, PathFile, load_path, ramp_rows, read_rows, thin_rows
from multilift_marl.planning.paths import own_time
from multilift_marl.planning.spline import fit_spline, sample_spline
from multilift_marl.schema.files import pin_file

ROWS = loop(33, turn=1.0)


def read(path):
    return read_rows(pin_file(str(path)))


def lines(rows, separator=",", point="."):
    return [separator.join(f"{value:.6f}".replace(".", point) for value in row) for row in rows]


@pytest.mark.parametrize(
    "head, separator, point, end",
    [
        (["t;x;y;z;yaw"], ";", ".", "\n"),
        (["t;x;y;z;yaw"], ";", ",", "\n"),
        (["t\tx\ty\tz\tyaw"], "\t", ".", "\n"),
        (["t x y z yaw"], "   ", ".", "\n"),
        (["# flight 7", "# t,x,y,z,yaw"], ",", ".", "\n"),
        (["# flight 7", "# of May", "t,x,y,z,yaw"], ",", ".", "\r\n"),
        (["% flight 7", "% of May"], ",", ".", "\n"),
        (["t,x,y,z,yaw", "s,m,m,m,rad"], ",", ".", "\n"),
        (["t,x,y,z,yaw"], ",", ".", "\r"),
        (['"t","x","y","z","yaw"'], ",", ".", "\n"),
        (["t [s], x [m], y [m], z [m], yaw [rad]"], ",", ".", "\n"),
        (["Time_s;X_m;Y_m;Z_m;Yaw(rad)"], ";", ".", "\n"),
    ],
)  # fmt: skip
def test_text_is_read_as_spreadsheets_and_loggers_write_it(head, separator, point, end, tmp_path):
    path = tmp_path / "path.csv"
    path.write_bytes(end.join([*head, *lines(ROWS, separator, point), ""]).encode())
    np.testing.assert_allclose(read(path), ROWS, atol=1e-6)


def test_a_separator_at_the_end_of_lines_and_comments_between_them_count_for_nothing(tmp_path):
    text = lines(ROWS[:, :4])
    (tmp_path / "path.csv").write_text("t,x,y,z,\n" + ",\n".join([*text[:5], "# paused", *text[5:]]) + ",\n")
    np.testing.assert_allclose(read(tmp_path / "path.csv")[:, :4], ROWS[:, :4], atol=1e-6)


@pytest.mark.parametrize("name", ["path.csv", "path.npz"])
@pytest.mark.parametrize(
    "header, factors",
    [
        ("t_ms,x,y,z,yaw", (1e3, 1, 1, 1, 1)),
        ("t_us,x_mm,y_mm,z_mm,yaw_deg", (1e6, 1e3, 1e3, 1e3, 180 / pi)),
        ("t_ns,x_cm,y_cm,z_cm,yaw_deg", (1e9, 1e2, 1e2, 1e2, 180 / pi)),
    ],
)
def test_columns_that_name_their_unit_are_read_in_it(name, header, factors, tmp_path):
    path = save(tmp_path, ROWS * factors + [1e9 * factors[0], 0, 0, 0, 0], name, header=header)
    np.testing.assert_allclose(read(path), ROWS, atol=1e-5)


@pytest.mark.parametrize("unit, factor", [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("radius", [0.3, 2.0])
def test_times_in_another_unit_are_refused_with_the_likely_one(unit, factor, radius, tmp_path):
    path = save(tmp_path, loop(radius=radius) * [factor, 1, 1, 1, 1])
    message = refusal(make, "track", **options(path))
    assert f"if t is in {unit}, name its column t_{unit}" in message and f"takes {8 * factor:.4g} s" in message


@pytest.mark.parametrize(
    "yaw",
    [
        lambda s: 90 * s,
        lambda s: 35 * np.sin(2 * pi * s),
        lambda s: (720 * s + 180) % 360 - 180,
        lambda s: (100 * s + 300) % 360,
        lambda s: np.round(20 * s),
    ],
)
def test_yaw_in_degrees_is_refused_and_read_where_it_says_so(yaw, tmp_path):
    rows = loop()
    rows[:, 4] = yaw(np.linspace(0, 1, len(rows)))
    assert "if it is in degrees, name its column yaw_deg" in refusal(read, save(tmp_path, rows))
    turned = read(save(tmp_path, rows, header="t,x,y,z,yaw_deg"))[:, 4]
    np.testing.assert_allclose(np.cos(turned), np.cos(np.deg2rad(rows[:, 4])), atol=1e-9)
    assert np.abs(np.diff(turned)).max() < 0.2


def test_yaw_of_more_than_a_turn_is_as_written_however_far_rows_are_apart(tmp_path):
    rows = np.column_stack([np.arange(0, 20, 2.0), np.zeros((10, 2)), np.full(10, 2.0), 4.1 * np.arange(10)])
    np.testing.assert_allclose(read(save(tmp_path, rows))[:, 4], rows[:, 4])  # 2 rad/s


def test_yaw_that_may_turn_either_way_is_refused(tmp_path):
    rows = np.column_stack([np.arange(0, 8, 2.0), np.zeros((4, 2)), np.full(4, 2.0), [0, 4.0, 4.0, 4.0]])
    assert "yaw may turn either way from row 1 (0 rad) to row 2 (4 rad)" in refusal(read, save(tmp_path, rows))
    rows[:, 4] = [3.1, -3.1, -2.9, -2.8]  # across the leap of a turn
    np.testing.assert_allclose(read(save(tmp_path, rows))[:, 4], [3.1, 2 * pi - 3.1, 2 * pi - 2.9, 2 * pi - 2.8])


@pytest.mark.parametrize(
    "header, words",
    [
        ("t,x,y,z,heading", "column heading is not read and the target does not turn; name it yaw"),
        ("t,x,y,z,qw", "column qw is not read and the target does not turn"),
    ],
)
def test_columns_that_turn_and_are_not_read_are_said(header, words, tmp_path, caplog):
    warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert (read(save(tmp_path, ROWS, header=header))[:, 4] == 0).all()
    assert words in caplog.text
    caplog.clear()
    read(save(tmp_path, ROWS, header="t,x,y,z,battery"))
    assert not caplog.records


def test_a_path_longer_than_its_episode_is_said(tmp_path, caplog):
    warn_once.cache_clear()
    path = save(tmp_path, loop() * [7.5, 1, 1, 1, 1])
    with caplog.at_level(logging.WARNING):
        make("track", num_envs=1, **options(path))
    assert "takes 60 s, but an episode ends after 20 s; set env.episode_seconds=60 to fly all of it" in caplog.text
    caplog.clear()
    make("track", num_envs=1, **options(save(tmp_path, loop())))
    assert not caplog.records


@pytest.mark.parametrize(
    "text, words",
    [
        ("t,x,y,z\n" + "0" * 200_000 + "x,0,0,2\n", "unlike"),
        ("t,x,y,z\n0,0,0,2\n" + "a" * 200_000 + ",0,0,2\n", "in row 2; give a number"),
        ("t,x,y,z\n" + "\n".join(f"{t}e300,0,0,2" for t in range(6)), "as t in row 2; correct it"),
        ("t,x,y,z\n" + "\n".join(f"{t},0,1e300,2" for t in range(6)), "1e+300 as y in row 1; correct it"),
        ("t,x,y,z\n" + "\n".join(f"{t}e-300,0,0,2" for t in range(6)), "less than 1e-05 s; raise"),
        ("t,x,y,z\r0,0,0,2\r1,0,b,2\r", "'b' in row 2"),
        ("t,x,y,z\n0,0,0,2\n1,0\x00,0,2\n", "in row 2; give a number"),
    ],
)
def test_text_that_is_no_table_is_refused_in_one_sentence(text, words, tmp_path):
    (tmp_path / "path.csv").write_bytes(text.encode())
    message = refusal(make, "track", **options(str(tmp_path / "path.csv"), file_spacing=0.0))
    assert message.startswith(f"task_options.file={tmp_path / 'path.csv'}") and len(message) < 600
    assert words in message or words == "unlike", message


def test_a_long_number_is_a_number(tmp_path):
    text = lines(ROWS)
    text[3] = "0" * 200_000 + text[3]
    (tmp_path / "path.csv").write_text("\n".join(text))
    np.testing.assert_allclose(read(tmp_path / "path.csv"), ROWS, atol=1e-6)


def test_a_path_of_too_many_rows_is_refused_before_its_spline_is_fitted(tmp_path):
    t = 0.1 * np.arange(200_000)
    path = save(tmp_path, np.column_stack([t, np.sin(t / 9), 0 * t, 2 + 0 * t]), "path.npy")
    message = refusal(make, "track", **options(path))
    assert f"200000 rows, more than {MAX_ROWS}; raise task_options.file_spacing=0.1 s" in message


def test_rows_close_together_are_thinned_whatever_their_number(tmp_path):
    t = 1e-4 * np.arange(200_001)
    rows = np.column_stack([t, np.sin(t / 9), 0 * t, 2 + 0 * t, 0 * t])
    thin = thin_rows(read(save(tmp_path, rows, "path.npy")), 0.5)
    np.testing.assert_allclose(thin[:, 0], 0.5 * np.arange(41), atol=1e-3)
    np.testing.assert_allclose(thin[:, 1], np.sin(thin[:, 0] / 9), atol=1e-5)


def bomb(folder, name, size):
    """Return the path of an .npz file whose array `name` unpacks to `size` bytes of zeros."""
    path, header = folder / "path.npz", io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (size // 8,)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, column in zip("txyz", loop().T, strict=False):
            if key != name:
                own = io.BytesIO()
                np.save(own, column)
                archive.writestr(f"{key}.npy", own.getvalue())
        with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
            member.write(header.getvalue())
            member.write(bytes(size))
    return path


def test_an_archive_that_unpacks_to_more_than_a_path_needs_is_refused_by_its_directory(tmp_path, monkeypatch):
    monkeypatch.setattr(path_table, "MAX_BYTES", 10**6)
    path = bomb(tmp_path, "x", 2 * 10**6)
    assert path.stat().st_size < 10**4
    monkeypatch.setattr(zipfile.ZipFile, "read", unread := Mock(wraps=None))
    assert "unpacks to 2 MB, more than 1" in refusal(read, path)
    assert not unread.called
    monkeypatch.undo()
    assert len(read(bomb(tmp_path, "camera", 2 * 10**6))) == len(loop())  # what is not read is not unpacked


@pytest.mark.parametrize("name", ["path.npy", "path.npz"])
def test_an_array_that_promises_more_than_it_holds_is_refused(name, tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**10, 4)})
    if name.endswith("npy"):
        (tmp_path / name).write_bytes(header.getvalue() + bytes(1000))
    else:
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            for key in "txyz":
                archive.writestr(f"{key}.npy", header.getvalue() + bytes(1000))
    assert "is damaged or no array of numbers" in refusal(read, tmp_path / name)


def test_a_ramp_is_that_of_the_formulas(tmp_path):
    """Along a straight line at 1.5 m/s, begun and ended in motion."""
    t = np.arange(0, 10.01, 0.1)
    rows = np.column_stack([t, 1.5 * t, 0 * t, 2 + 0 * t, 0 * t])
    table = fit_spline(ramp_rows(rows, 2.0))
    assert table[-1, 0] == pytest.approx(12.0)
    at = np.linspace(0, 6, 200)
    exact = np.array([1.5 * own_time(each) for each in at])
    np.testing.assert_allclose(sample_spline(table, at)[0, :, 0], exact, atol=1e-4)
    np.testing.assert_allclose(sample_spline(table, 12.0 - at)[0, :, 0], 15.0 - exact, atol=1e-4)
    speeds = sample_spline(table, np.linspace(2.2, 9.8, 50))[1, :, 0]
    np.testing.assert_allclose(speeds, 1.5, atol=1e-3)


def test_a_ramp_keeps_to_the_curve(tmp_path):
    t = np.arange(0, 6.001, 0.05)
    rows = np.column_stack([t, 2 * np.cos(t), 2 * np.sin(t), 2 + 0 * t, t])
    table = fit_spline(ramp_rows(thin_rows(rows, 0.1), 2.0))
    values = sample_spline(table, np.linspace(0, 8, 300))
    np.testing.assert_allclose(np.hypot(values[0, :, 0], values[0, :, 1]), 2.0, atol=2e-3)
    np.testing.assert_allclose(np.hypot(values[1, :, 0], values[1, :, 1]), 2 * np.abs(values[1, :, 3]), atol=2e-2)
    assert np.abs(values[1, :, 3]).max() < 1.01  # it never turns faster than written


def test_a_log_that_begins_in_motion_flies_with_a_ramp(tmp_path):
    t = np.arange(0, 12.01, 0.02)
    path = save(tmp_path, np.column_stack([t, 3.0 * t, 0 * t, 0 * t]), "log.npy")
    short = options(path, file_offset=[0.0, 0.0, 2.0])
    assert "or give it task_options.file_ramp=2 to do so" in refusal(make, "track", **short)
    assert "lift it by task_options.file_offset" in refusal(make, "track", **options(path, file_ramp=2.0))
    vec = make("track", num_envs=1, **short, **{"task_options.file_ramp": 2.0})
    vec.reset(seed=0)
    np.testing.assert_allclose(vec.task.goal.position[0], [0, 0, 2.0], atol=1e-9)
    assert "file_ramp=20 s is longer than the 12 s of" in refusal(
        make, "track", **short, task_options={"file_ramp": 20}
    )


def polynomials():
    """Return pieces (2, 33) that meet with all derivatives up to the third: one polynomial, cut at 2 s."""
    rng = np.random.default_rng(3)
    first = np.polynomial.Polynomial
    whole = [first([0, 0, 0, 0, *rng.uniform(-0.02, 0.02, 4) * [1, 0.3, 0.05, 0.01]]) for _ in range(4)]
    later = [each(first([2.0, 1.0])) for each in whole]
    return whole, np.array([[duration, *np.concatenate([np.pad(p.coef, (0, 8 - len(p.coef))) for p in each])]
                            for duration, each in ((2.0, whole), (1.5, later))])  # fmt: skip


@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize("name", ["path.csv", "path.npy"])
def test_polynomials_of_planners_are_the_path(header, name, tmp_path):
    """As uav_trajectories writes them: a duration, then eight coefficients of x, y, z and yaw in a row."""
    whole, pieces = polynomials()
    names = "duration," + ",".join(f"{axis}^{power}" for axis in ("x", "y", "z", "yaw") for power in range(8))
    path = save(tmp_path, pieces, name, header=names if header else "")
    rows = read(path)
    assert rows[-1, 0] == pytest.approx(3.5) and np.diff(rows[:, 0]).min() > 0.0999
    np.testing.assert_allclose(rows[:, 1:], np.stack([each(rows[:, 0]) for each in whole], axis=1), atol=1e-9)
    table, at = fit_spline(thin_rows(rows, 0.1)), np.linspace(0.5, 2.2, 100)
    for order, tolerance in ((0, 3e-5), (1, 1e-3), (2, 1e-2)):
        exact = np.stack([each.deriv(order)(at) if order else each(at) for each in whole], axis=1)
        np.testing.assert_allclose(sample_spline(table, at)[order], exact, atol=tolerance)


def test_polynomials_that_do_not_meet_are_refused(tmp_path):
    _, pieces = polynomials()
    pieces[1, 1] += 0.3
    assert "polynomial 2 begins 0.3 m from where polynomial 1 ends" in refusal(read, save(tmp_path, pieces, "p.npy"))
    pieces[1, 0] = -1.0
    assert "last no positive time" in refusal(read, save(tmp_path, pieces, "p.npy"))


def test_a_spline_is_loaded_in_one_call(tmp_path):
    config = make("track", num_envs=1).config
    file = PathFile(pin_file(save(tmp_path, loop())), 0.1, 0.0, (1.0, 2.0, 0.5))
    table = load_path(file, 20.0, config.system, config.randomization)
    np.testing.assert_allclose(table[0, 1:4], [1.0, 2.0, 2.5], atol=1e-12)
    assert table[-1, 0] == LENGTH


def test_the_yaw_of_polynomials_goes_on_by_whole_turns(tmp_path):
    """A planner may give the yaw of every piece anew between -180 and 180 degrees."""
    pieces = np.zeros((3, 33))
    pieces[:, 0] = 1.0
    pieces[:, 17] = 2.0  # z
    for i, start in enumerate((3.0, 3.5 - 2 * np.pi, 4.0 + 2 * np.pi)):
        pieces[i, 25:27] = start, 0.5
    yaw = path_table.sample_polynomials(tmp_path / "p.csv", pieces)[:, 4]
    assert yaw == pytest.approx(np.linspace(3.0, 4.5, len(yaw)), abs=1e-12)

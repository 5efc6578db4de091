"""Tables of paths: text with separators, NumPy's arrays, and polynomials of trajectory planners."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError, shorten, warn_once
from multilift_marl.schema.files import MAX_BYTES

KEY = "task_options.file"
COLUMNS = ("t", "x", "y", "z", "yaw")
SAMPLING = 0.1  # [s] between the rows made of polynomials
_DEGREES = 8  # coefficients of a polynomial, the constant first
_POLYNOMIALS = 1 + 4 * _DEGREES  # columns: duration, then x, y, z and yaw
_GAP = 0.01  # [m] between the end of a polynomial and the start of the next
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_UNITS = {
    "t": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "x": _LENGTH, "y": _LENGTH, "z": _LENGTH,
    "yaw": {"rad": 1.0, "deg": np.pi / 180},
}  # fmt: skip
_NAME = re.compile(r"(time|t|x|yaw|y|z)[\s_]*[\[(]?\s*([a-zµ]*)\s*[\])]?")
_TURNING = re.compile(r"yaw|heading|psi|qw")


class Chosen(NamedTuple):
    """A column of a table that is read: its place, and the factor to SI units."""

    place: int
    factor: float


def read_table(source: str, content: bytes) -> np.ndarray:
    """Return the rows (K, 4) or (K, 5) of a file, its columns in this order: t [s], x, y, z [m], yaw [rad].

    Args:
        source: key and path of the file, for messages; its ending says what it is.
        content: of the file.

    Raises:
        ConfigError: not the table that is expected.
    """
    readers = {".csv": _read_text, ".npy": _read_array, ".npz": _read_arrays}
    reader = readers.get(Path(source).suffix.lower())
    if reader is None:
        raise ConfigError(f"{source} is no .csv, .npy or .npz file; save the path as one of these")
    return reader(source, content)


def read_columns(source: str, content: bytes, needed: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the columns (K,) of a text file by their names, those of `COLUMNS` that it has, in SI units.

    Args:
        source: key and path of the file, for messages.
        content: of the file.
        needed: columns that must be there.

    Raises:
        ConfigError: not the table that is expected.
    """
    above, data, separator = _split_text(source, content)
    if not above or not data:
        raise ConfigError(f"{source} needs a line of names and a row of numbers for each way-point; give it both")
    chosen = choose_columns(source, _name_cells(above[-1], separator, len(_split(data[0], separator))), needed=needed)
    numbers = _read_numbers(source, data, separator)
    _check_width(source, chosen, numbers)
    return {name: numbers[:, place] * factor for name, (place, factor) in chosen.items()}


def choose_columns(
    source: str, names: Sequence[str], units: Sequence[str] = (), needed: Sequence[str] = COLUMNS[:4]
) -> dict[str, Chosen]:
    """Return the columns of `COLUMNS` that there are, in that order.

    Args:
        source: key and path of the file, for messages.
        names: of its columns, with units as in "t_ms", "x [mm]" or "yaw_deg", or without.
        units: of its columns where they stand apart.
        needed: columns that must be there.

    Raises:
        ConfigError: one of these is missing.
    """
    found: dict[str, Chosen] = {}
    for place, name in enumerate(names):
        known = _NAME.fullmatch(name)
        column = known[1].replace("time", "t") if known else ""
        unit = (known[2] if known else "") or (units[place] if place < len(units) else "")
        if column and unit in ("", *_UNITS[column]) and (column not in found or name == column):
            found[column] = Chosen(place, _UNITS[column].get(unit, 1.0))
    if missing := [name for name in needed if name not in found]:
        raise ConfigError(
            f"{source} has no column {missing[0]} (its first line names {shorten(', '.join(names))}); name the "
            f"columns {', '.join(needed)} and, if it turns, yaw"
        )
    if "yaw" not in found and (turning := [name for name in names if _TURNING.search(name)]):
        warn_once(
            "tasks", f"{source}: column {turning[0]} is not read and the target does not turn; name it yaw, or "
            "yaw_deg if it is in degrees",
        )  # fmt: skip
    return {name: found[name] for name in COLUMNS if name in found}


def _read_text(source: str, content: bytes) -> np.ndarray:
    """Return the rows of a text file: separators, names and units are found in it, comments are left out."""
    above, data, separator = _split_text(source, content)
    chosen = _read_names(source, above, separator, len(_split(data[0], separator)) if data else 0)
    numbers = _read_numbers(source, data, separator)
    if numbers.shape[1] == _POLYNOMIALS and (chosen is None or not chosen):
        return sample_polynomials(source, numbers)
    if chosen is None:
        return numbers
    _check_width(source, chosen, numbers)
    return np.stack([numbers[:, place] * factor for place, factor in chosen.values()], axis=1)


def _split_text(source: str, content: bytes) -> tuple[list[str], list[str], str]:
    """Return the lines above the numbers of a text file, those of numbers, and what separates their columns."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(f"{source} is no text; save it as comma-separated values in UTF-8") from None
    lines = [line.strip() for line in text.replace('"', "").splitlines()]
    lines = [line for line in lines if line.strip(",; \t")]
    first = next((i for i, line in enumerate(lines) if _is_row(line)), len(lines))
    data = [line for line in lines[first:] if line[0] not in "#%"]
    return lines[:first], data, _separator(data[0]) if data else ","


def _check_width(source: str, chosen: dict[str, Chosen], numbers: np.ndarray) -> None:
    if (named := 1 + max(place for place, _ in chosen.values())) > numbers.shape[1]:
        raise ConfigError(f"{source} names {named} columns or more, but has {numbers.shape[1]}; correct it")


def _name_cells(line: str, separator: str, width: int) -> list[str]:
    """Return what the cells of a line of names hold, in lower case; the mark of a comment is none of them."""
    mark = separator if separator in line else _separator(line)
    cells = [cell.strip("#% ").lower() for cell in _split(line, mark)]
    return cells[1:] if line[0] in "#%" and not cells[0] and len(cells) > width else cells


def _read_names(source: str, lines: list[str], separator: str, width: int) -> dict[str, Chosen] | None:
    """Return the columns by the lines above the numbers, None if they name none; {} for polynomials."""
    cells = [_name_cells(line, separator, width) for line in lines]
    is_comment = [line[0] in "#%" for line in lines]
    for i in reversed(range(len(lines))):
        if width == _POLYNOMIALS and cells[i][0] == "duration":
            return {}
        matches = [_NAME.fullmatch(cell) for cell in cells[i]]
        columns = {match[1].replace("time", "t") for match in matches if match}
        if columns.issuperset(COLUMNS[:4]) or (not is_comment[i] and not _are_units(cells[i])):
            return choose_columns(source, cells[i], cells[i + 1] if i + 1 < len(cells) else ())
    return None


def _are_units(cells: list[str]) -> bool:
    known = {unit for units in _UNITS.values() for unit in units}
    return all(cell.strip("[]()") in known for cell in cells)


def _separator(line: str) -> str:
    return next((separator for separator in ";\t," if separator in line), " ")


def _split(line: str, separator: str) -> list[str]:
    """Return the cells of a line; one separator at its end adds none."""
    cells = line.split() if separator == " " else line.split(separator)
    return [cell.strip() for cell in (cells[:-1] if cells and not cells[-1].strip() else cells)]


def _is_row(line: str) -> bool:
    separator = _separator(line)
    return all(_number(cell, separator) is not None for cell in _split(line, separator))


def _number(cell: str, separator: str) -> float | None:
    """Return the number in a cell, None if there is none; between other separators a comma may be a point."""
    try:
        return float(cell if separator == "," else cell.replace(",", "."))
    except ValueError:
        return None


def _read_numbers(source: str, lines: list[str], separator: str) -> np.ndarray:
    """Return the numbers of lines of equal length (K, C), (0, 4) if there are none."""
    if not lines:
        return np.zeros((0, 4))
    rows = [line.removesuffix(separator) if separator != " " else line for line in lines]
    if separator != "," and any("," in line for line in rows):
        rows = [line.replace(",", ".") for line in rows]
    try:
        return np.loadtxt(rows, delimiter=None if separator == " " else separator, ndmin=2, comments=None)
    except ValueError:
        pass  # found below
    width = len(_split(lines[0], separator))
    for i, line in enumerate(lines, start=1):
        cells = _split(line, separator)
        if wrong := [cell for cell in cells if _number(cell, separator) is None]:
            raise ConfigError(f"{source} holds '{shorten(wrong[0], 40)}' in row {i}; give a number")
        if len(cells) != width:
            raise ConfigError(f"{source} has {len(cells)} columns in row {i}, unlike the rows before; correct it")
    raise ConfigError(f"{source} is no table of numbers; save it as comma-separated values again")


def sample_polynomials(source: str, pieces: np.ndarray) -> np.ndarray:
    """Return rows (K, 5) of a path of polynomials: each a duration [s], then 8 coefficients of x, y, z [m], yaw [rad].

    As planners of uav_trajectories and Crazyswarm write them, the constant first, in the piece's own time.

    Args:
        source: key and path of the file, for messages.
        pieces: (P, 33).

    Raises:
        ConfigError: durations or coefficients that cannot be, or pieces that do not meet.
    """
    durations, coefficients = pieces[:, 0], pieces[:, 1:].reshape(-1, 4, _DEGREES)
    if not np.isfinite(pieces).all() or not (durations > 0).all() or durations.sum() > 1e5:
        raise ConfigError(f"{source} holds polynomials that last no positive time, or over 1e5 s; correct them")
    counts = np.maximum(1, np.floor(durations / SAMPLING + 1e-9)).astype(int)
    rows, begin, last = [], 0.0, np.zeros(4)
    for i, (duration, count) in enumerate(zip(durations, counts, strict=True)):
        t = np.linspace(0.0, duration, count + 1)
        values = np.stack([np.polynomial.polynomial.polyval(t, each) for each in coefficients[i]], axis=1)
        if i > 0:
            # Planners may begin a piece in another turn: the one that goes on from the last piece.
            values[:, 3] += 2 * np.pi * np.round((last[3] - values[0, 3]) / (2 * np.pi))
            gap = float(np.linalg.norm(values[0, :3] - last[:3]))
            if not gap <= _GAP:
                raise ConfigError(
                    f"{source}: polynomial {i + 1} begins {gap:.3g} m from where polynomial {i} ends; correct it"
                )
        last = values[-1]
        # A later piece begins with the row that the last one ended with.
        rows.append(np.column_stack([begin + t, values])[min(i, 1) :])
        begin += duration
    return np.concatenate(rows)


def _read_array(source: str, content: bytes) -> np.ndarray:
    if zipfile.is_zipfile(io.BytesIO(content)):
        raise ConfigError(f"{source} holds several arrays, as an .npz file does; name it so")
    array = _parse_array(source, content)
    return sample_polynomials(source, array) if array.ndim == 2 and array.shape[1] == _POLYNOMIALS else array


def _read_arrays(source: str, content: bytes) -> np.ndarray:
    """Return the columns of an .npz file, its arrays t, x, y, z and yaw; others are not unpacked."""
    if content.startswith(b"\x93NUMPY"):
        raise ConfigError(f"{source} holds one array, as an .npy file does; name it so")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            names = list(members)
            try:
                chosen = [*choose_columns(source, [name.lower() for name in names]).values()]
            except ConfigError as error:
                raise ConfigError(str(error).replace("column", "array", 1).replace("its first line", "it")) from None
            size = sum(members[names[place]].file_size for place, _ in chosen)
            if size > MAX_BYTES:
                raise ConfigError(f"{source} unpacks to {size / 1e6:.3g} MB, more than {MAX_BYTES // 10**6}")
            arrays = [_parse_array(source, archive.read(members[names[place]])) * factor for place, factor in chosen]
    except ConfigError:
        raise
    except Exception:  # zipfile and zlib raise many kinds for damaged files
        raise ConfigError(f"{source} is damaged or no array of numbers; save it by numpy.savez again") from None
    if any(array.shape != arrays[0].shape or array.ndim != 1 for array in arrays):
        raise ConfigError(f"{source} holds arrays of different shapes; give each one number for every time")
    return np.stack(arrays, axis=1)


def _parse_array(source: str, content: bytes) -> np.ndarray:
    """Return an array of real numbers; what its header promises beyond the content is not made room for."""
    try:
        file = io.BytesIO(content)
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = header(file)
        if prod(shape) * kind.itemsize > len(content):
            raise ValueError
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # numpy raises many kinds for damaged files
        raise ConfigError(f"{source} is damaged or no array of numbers; save it by numpy.save again") from None
    if array.dtype.kind not in "iuf":
        raise ConfigError(f"{source} holds {array.dtype} values; save an array of real numbers")
    return array.astype(float)

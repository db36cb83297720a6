"""CSV files from a lab, read strictly: an ambiguous number is refused."""

from __future__ import annotations

import csv
import gzip
import io
import math
import re
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simbias.core.messages import quote, words
from simbias.core.records import Array
from simbias.core.robot import HardwareError

# float() would also take 1_2, digits of other scripts, and words such as nan
POINT, COMMA = (
    re.compile(rf"[+-]?([0-9]+[{mark}]?[0-9]*|[{mark}][0-9]+)([eE][+-]?[0-9]+)?") for mark in ".,"
)
COMMENTS = re.compile(r"(\s*#[^\n]*\n)+(?!\s*[-+.0-9])")  # but not names after a #, directly above numbers
LARGEST = 2**29  # bytes of text: hours at 1 kHz; a compressed file of some kB may hold more
DECIMAL_COMMA = "; is it a decimal comma? Write a point, or separate the columns by semicolons"


@dataclass(frozen=True)
class Table:
    """The cells of a CSV file."""

    source: str  # the file, as errors name it
    names: tuple[str, ...]  # cells of the first row
    rows: tuple[int, ...]  # (r,) line numbers of the other rows in the file
    cells: Sequence[Sequence[str]]  # (r, c)
    decimal_commas: bool  # whether numbers may have them, since commas do not separate columns
    cut: int | None = None  # row of an unterminated last line, which is left out

    def numbers(self, columns: Sequence[int], may_be_blank: Collection[int] = ()) -> Array:
        """The numbers (r, k) in some columns; blank cells, allowed in some columns of the last row, are 0.

        HardwareError, with row and column, if a cell is not a finite number.
        """
        given = [cells[column] for cells in self.cells for column in columns]
        with_comma, with_point = (sum(mark in cell for cell in given) for mark in ",.")
        commas = self.decimal_commas and with_comma > with_point
        number, last = COMMA if commas else POINT, len(self.rows) - 1
        table = np.zeros((len(self.rows), len(columns)))
        for index, cells in enumerate(self.cells):
            for place, column in enumerate(columns):
                cell = cells[column].strip()
                if not cell and index == last and column in may_be_blank:
                    continue
                value = float(cell.replace(",", ".")) if number.fullmatch(cell) else math.nan
                if not math.isfinite(value):
                    raise self.error(index, column, f"expected a finite number, got {quote(cell)}", cell)
                table[index, place] = value
        return table

    def error(self, index: int, column: int, problem: str, cell: str = "") -> HardwareError:
        """An error in a cell, with the likely reason."""
        reason = DECIMAL_COMMA if COMMA.fullmatch(cell) and not self.decimal_commas else ""
        where = f"row {self.rows[index]}, column {self.names[column].partition('(')[0].strip()}"
        return HardwareError(f"{self.source}: {where}: {problem}{reason}")


def read_table(path: Path, may_lack: str = "", may_be_cut: bool = False, whole_lines: bool = False) -> Table:
    """The table in a CSV file, also compressed (.gz), its columns separated by commas, semicolons or tabs.

    Lines of # before the names are comments. Rows may lack the column `may_lack`, if it is the last one. If
    the log `may_be_cut` off, a last row is left out if it is unterminated and lacks cells; with
    `whole_lines`, any unterminated last row, as its last cell may be cut.

    HardwareError if it cannot be read, is too large, or a row's number of cells differs from the header's.
    """
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            raw = file.read(LARGEST + 1)
        text = raw.decode("utf-8-sig") if len(raw) <= LARGEST else ""
    except UnicodeDecodeError as error:
        raise HardwareError(f"{path}: is not UTF-8 text ({words(error)}); save it as UTF-8") from error
    except (OSError, EOFError, zlib.error) as error:
        raise HardwareError(f"{path}: cannot be read ({words(error)})") from error
    if len(raw) > LARGEST:
        raise HardwareError(f"{path}: holds more than {LARGEST // 2**20} MiB")
    comments = COMMENTS.match(text)
    begin = comments.end() if comments else 0
    head = text[begin:].lstrip().partition("\n")[0]
    separator = next((mark for mark in ";\t" if mark in head and "," not in head), ",")
    try:
        reader = csv.reader(io.StringIO(text[begin:]), delimiter=separator)
        lines = [(i, row) for i, row in enumerate(reader, 1 + text[:begin].count("\n")) if any(row)]
    except csv.Error as error:
        raise HardwareError(f"{path}: is not a CSV file ({words(error)})") from error
    names, cells, cut = tuple(cell.strip() for cell in lines[0][1]) if lines else (), [], None
    may_be_cut = may_be_cut and bool(lines) and not text.endswith(("\n", "\r"))
    if may_be_cut and (whole_lines or len(lines[-1][1]) < len(names)):
        cut = lines.pop()[0]
    if len(lines) < 2:
        raise HardwareError(f"{path}: expected a header and rows, got {len(lines)} lines")
    for number, row in lines[1:]:
        whole = [*row, ""] if len(row) == len(names) - 1 and names[-1] == may_lack else row
        if len(whole) != len(names):
            reason = DECIMAL_COMMA if len(row) > len(names) and separator == "," else ""
            wanted = f"expected {len(names)} cells as in row {lines[0][0]}"
            raise HardwareError(f"{path}: row {number}: {wanted}, got {len(row)}{reason}")
        cells.append(whole)
    rows = tuple(number for number, _ in lines[1:])
    return Table(str(path), names, rows, cells, separator != ",", cut)

"""A figure of a sweep with its numbers and caption, and its files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

from pandas import DataFrame

from simbias.pictures.elements.style import save

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure of a sweep."""

    figure: Figure
    numbers: DataFrame  # all that it shows, or their sums
    caption: str
    animate: Callable[[Path], object] | None = None  # writes a GIF

    def write(self, folder: Path, name: str) -> list[Path]:
        """Write name.png, .svg, .csv, .md (the caption) and, with an animation, .gif; return their paths."""
        paths = [folder / f"{name}{suffix}" for suffix in (".png", ".svg", ".csv", ".md")]
        png, svg, csv, md = paths
        save(self.figure, png)
        save(self.figure, svg)
        self.numbers.to_csv(csv, index=False, float_format="%.6g")
        md.write_text(fill(self.caption, 110) + "\n")
        if self.animate is not None:
            paths.append(folder / f"{name}.gif")
            self.animate(paths[-1])
        return paths

"""Records in, Matplotlib figures out.

No function uses pyplot, so none needs a display or leaves an open figure. Save a figure with `save`, or let a
notebook show a returned figure. Pictures of a trial take its study and its iterations, from `study.run()` or
`simbias.load_trial`. If a trial cannot have a picture, because its method does not search or learn, a
`NoPictureError` is raised. A task is drawn by the module beside it (`simbias.pictures.elements.drawing`).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simbias.pictures.elements.drawing import Drawing, NoPictureError, drawing_of
    from simbias.pictures.elements.style import save
    from simbias.pictures.trial.animation import save_animation
    from simbias.pictures.trial.costs import costs
    from simbias.pictures.trial.errors import prediction_errors
    from simbias.pictures.trial.following import following
    from simbias.pictures.trial.forecast import forecast
    from simbias.pictures.trial.overview import overview
    from simbias.pictures.trial.phases import phases
    from simbias.pictures.trial.rejections import rejections
    from simbias.pictures.trial.snapshots import snapshots

__all__ = [
    "Drawing",
    "NoPictureError",
    "costs",
    "drawing_of",
    "following",
    "forecast",
    "overview",
    "phases",
    "prediction_errors",
    "rejections",
    "save",
    "save_animation",
    "snapshots",
]

_MODULES = {  # names that differ from those of their modules
    **dict.fromkeys(("Drawing", "NoPictureError", "drawing_of"), "elements.drawing"),
    "save": "elements.style",
    "save_animation": "trial.animation",
    "prediction_errors": "trial.errors",
}


def __getattr__(name: str) -> Any:
    """Import a name in `__all__` on demand: Matplotlib takes a third of a second."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = _MODULES.get(name, f"trial.{name}")
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)

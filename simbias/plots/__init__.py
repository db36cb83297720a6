"""Records in, Matplotlib figures out.

No function touches pyplot, so none needs a display or leaves an open figure: save a figure with `save`, or
let a notebook show what a function returns. Those of a trial take its study and its iterations, as
`study.run()` yields them or `simbias.recorded.load_trial` reads them back. How a task looks is told by the
drawing beside it: the functions `draw` and `move` of the module `<the task's module>_drawing`.
"""

from simbias.plots.animation import save_animation
from simbias.plots.costs import costs
from simbias.plots.drawing import Drawing, drawing_of
from simbias.plots.errors import prediction_errors
from simbias.plots.forecast import forecast
from simbias.plots.overview import overview
from simbias.plots.phases import phases
from simbias.plots.rejections import rejections
from simbias.plots.snapshots import snapshots
from simbias.plots.style import save

__all__ = [
    "Drawing",
    "costs",
    "drawing_of",
    "forecast",
    "overview",
    "phases",
    "prediction_errors",
    "rejections",
    "save",
    "save_animation",
    "snapshots",
]

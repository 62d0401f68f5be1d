"""Pictures of episodes and plans; a drawing library is loaded by the first picture that needs it.

``Scene`` is what a picture shows. ``ansi(scene)`` draws it as text, ``rgb_array(scene)`` as pixels
(Pillow), ``Window`` shows pixels on the screen (pygame-ce), and ``draw_plan(problem, plan)`` draws
the routes of a plan (matplotlib).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

# Not lazy, as a submodule of the same name would otherwise hide the function once imported; these
# files load Pillow only when they draw.
from mapp_env.rendering.ansi import ansi
from mapp_env.rendering.rgb_array import rgb_array
from mapp_env.scene import Scene

if TYPE_CHECKING:
    from mapp_env.rendering.figures import draw_plan
    from mapp_env.rendering.human import Window

__all__ = ["Scene", "Window", "ansi", "draw_plan", "rgb_array"]

_LAZY = {
    "Window": "mapp_env.rendering.human",
    "draw_plan": "mapp_env.rendering.figures",
}


def __getattr__(name: str) -> Any:
    """Load the file of a lazy name on its first use."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

"""Pictures of episodes and plans; a drawing library is loaded by the first picture that needs it.

``ansi`` needs none; ``rgb_array`` and the GIFs of ``save_animation``, ``animate_plans`` and
``save_gif`` need Pillow, ``Window`` pygame-ce, ``draw_plan`` and ``compare_plans`` matplotlib.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mapp_env.engine.scene import Scene

# Not lazy, as a submodule of the same name would otherwise hide the function once imported; these
# files load Pillow only when they draw.
from mapp_env.rendering.ansi import ansi
from mapp_env.rendering.rgb_array import rgb_array

if TYPE_CHECKING:
    from mapp_env.rendering.animation import save_animation, save_gif
    from mapp_env.rendering.comparison import compare_plans
    from mapp_env.rendering.figures import draw_plan, save_figure
    from mapp_env.rendering.human import Window
    from mapp_env.rendering.side_by_side import animate_plans

__all__ = [
    "Scene",
    "Window",
    "animate_plans",
    "ansi",
    "compare_plans",
    "draw_plan",
    "rgb_array",
    "save_animation",
    "save_figure",
    "save_gif",
]

_LAZY = {
    "Window": "mapp_env.rendering.human",
    "animate_plans": "mapp_env.rendering.side_by_side",
    "compare_plans": "mapp_env.rendering.comparison",
    "draw_plan": "mapp_env.rendering.figures",
    "save_animation": "mapp_env.rendering.animation",
    "save_figure": "mapp_env.rendering.figures",
    "save_gif": "mapp_env.rendering.animation",
}


def __getattr__(name: str) -> Any:
    """Load the file of a lazy name on its first use."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(importlib.import_module(_LAZY[name]), name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != "matplotlib":
            raise
        raise ImportError(
            f'{name} needs matplotlib 3.8 or later: pip install "matplotlib>=3.8"',
            name="matplotlib",
        ) from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

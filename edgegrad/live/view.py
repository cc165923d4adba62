"""eg.viewer(): watch a fit, pause it and stop it.

Fits do not know of it, for it is a callback. It draws in the fit's own thread, so that nothing changes while it draws, and
takes only a small share of the time. The page's buttons are handled in threads of the server: they set flags that the next step
reads.
"""

from __future__ import annotations

import importlib.util
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from ..camera.camera import Camera
from ..check import check_int, check_positive
from ..optional import require
from ..scene.mesh import Mesh
from ..scene.scene import Scene

if TYPE_CHECKING:
    from ..fit.descent.result import Fit
    from ..fit.pose.camera_result import CameraFit
    from ..fit.pose.result import PoseFit
    from ..fit.rig.result import RigFit
    from .browser import Browser
    from .figure import NotebookFigure
    from .snapshot import Shown, Snapshot

MIN_INTERVAL = 0.1  # seconds between two drawings
POLL = 0.1  # seconds until a pause notices Ctrl-C


def viewer(port: int = 8080, host: str = "127.0.0.1", *, server: bool | None = None, share: float = 0.03) -> Viewer:
    """Open a live view of a fit: meshes, cameras with their pictures, target | render | difference, the loss, and buttons.

    The buttons pause and stop. The view shows the skeleton, too, in fit_rig().

        with eg.viewer() as view:
            print(view.url)
            fit = eg.fit.fit_pose(mesh, image, camera, callback=view)

    Parameters
    ----------
    port : int, default 8080
        Port of the page, or the next free one; 0: any.
    host : str, default "127.0.0.1"
        Address of the page. "127.0.0.1" is visible on this computer alone; "0.0.0.0" to all who reach it, without a password.
    server : bool, default None
        False: a figure that is updated in place in a notebook, without meshes and buttons. None: that figure in a notebook
        without viser, a page everywhere else.
    share : float, default 0.03
        Share of the time that drawing may take, 0.001 … 1.

    Raises
    ------
    TypeError, ValueError, ImportError
        An argument is wrong; the message names it. viser is missing (`pip install 'edgegrad[view]'`).
    """
    port = check_int("port", port, 0, 65535)
    if not isinstance(host, str):
        raise TypeError(f"host: expected a str, got {type(host).__name__}")
    if server is not None and not isinstance(server, bool):
        raise TypeError(f"server: expected True, False or None, got {type(server).__name__}")
    check_positive("share", share, least=1e-3, most=1.0)
    return Viewer(port, host, server, share)


class Viewer:
    """A live view, as viewer() opens it. It is the callback of any fit; a loop of one's own calls update()."""

    def __init__(self, port: int, host: str, server: bool | None, share: float) -> None:
        self._share = share
        self._display: Browser | NotebookFigure = self._opened(port, host, server)
        self._steps = 0
        self._losses: list[float] = []
        self._snapshot: Snapshot | None = None
        self._index = 0
        self._next = 0.0  # time of the next drawing
        self._drawing = threading.Lock()
        self._go, self._stop = threading.Event(), threading.Event()
        self._go.set()
        self._closed = self._ended = False

    def _opened(self, port: int, host: str, server: bool | None) -> Browser | NotebookFigure:
        if server is False and not in_notebook():
            raise ValueError("server: expected True outside of a notebook, got False; nothing there shows a figure")
        if server is False or (server is None and importlib.util.find_spec("viser") is None and in_notebook()):
            require("matplotlib", "edgegrad[figures]", "a figure in a notebook")
            from .figure import NotebookFigure

            return NotebookFigure()
        from .browser import Browser, Controls

        return Browser(host, port, Controls(self._toggle, self.stop, self._select_camera))

    # -- for users ------------------------------------------------------------------------------------------------------------

    @property
    def url(self) -> str | None:
        """Return the page's address; None for a figure."""
        return self._display.url

    @property
    def stopped(self) -> bool:
        """Return whether Stop was pressed in a loop of one's own. A fit that it ends resets it."""
        return self._stop.is_set()

    @property
    def paused(self) -> bool:
        """Return whether the fit waits."""
        return not self._go.is_set()

    def __call__(self, fit: Shown) -> None:
        """Serve as a fit's callback: draw when it is due, wait while paused, and raise KeyboardInterrupt after Stop, by which
        the fit ends with its best result."""
        from .snapshot import snapshot_from_fit

        if not self._step(_loss(fit), lambda: snapshot_from_fit(fit)):
            self._stop.clear()
            raise KeyboardInterrupt

    def update(
        self,
        scene: Mesh | Scene,
        cameras: Camera | Sequence[Camera] | None = None,
        images: Tensor | Sequence[Tensor] | None = None,
        *,
        masks: Tensor | Sequence[Tensor] | None = None,
        loss: Tensor | float | None = None,
    ) -> bool:
        """Report a step of one's own loop: draw when it is due, and wait while paused. Return False after Stop.

            if not view.update(scene, camera, image, loss=loss):
                break

        cameras, images and masks are as for fit_scene(). Raises TypeError or ValueError that names the argument.
        """
        from .snapshot import snapshot_from_scene

        number = None if loss is None else float(loss)
        return self._step(number, lambda: snapshot_from_scene(scene, cameras, images, masks))

    def show(self, fit: Fit | PoseFit | CameraFit | RigFit) -> None:
        """Draw a fit's result at once, for its last step may not have been drawn."""
        from .snapshot import snapshot_from_fit

        self._draw(snapshot_from_fit(fit))

    def wait(self) -> None:
        """Keep the page open until Ctrl-C or Stop, which now says Close."""
        if self.url is None:
            return
        self._ended = True
        self._label()
        try:
            while not self._stop.wait(POLL):
                pass
        except KeyboardInterrupt:
            pass

    def pause(self) -> None:
        self._go.clear()
        self._label()

    def resume(self) -> None:
        self._go.set()
        self._label()

    def stop(self) -> None:
        self._stop.set()
        self.resume()

    def close(self) -> None:
        """Close the page. A fit that goes on is no longer shown."""
        if not self._closed:
            self._closed = True
            self._go.set()
            self._display.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _repr_html_(self) -> str | None:
        """Show the page in a notebook."""
        if self.url is None:
            return None
        link = f'<a href="{self.url}" target="_blank">{self.url}</a>'
        return link if self._closed else f'{link}<iframe src="{self.url}" width="100%" height="600"></iframe>'

    def __repr__(self) -> str:
        return f"Viewer({self.url or 'figure'}{', closed' if self._closed else ''})"

    # -- steps ----------------------------------------------------------------------------------------------------------------

    def _step(self, loss: float | None, snapshot: Callable[[], Snapshot]) -> bool:
        """Return whether to go on."""
        if self._closed:
            return not self.stopped
        self._steps += 1
        if loss is not None:
            self._losses.append(loss)
        began, first = time.perf_counter(), self._snapshot is None
        if began >= self._next:
            self._draw(snapshot())
            now = time.perf_counter()
            # The first drawing sends textures and pictures, later ones send changes.
            self._next = now + max(MIN_INTERVAL, 0.0 if first else (now - began) * (1.0 / self._share - 1.0))
        if self.paused:
            self._draw(snapshot())
            while not self._go.wait(POLL):
                pass
            self._draw_state()
        return not self.stopped

    def _draw(self, snapshot: Snapshot) -> None:
        with self._drawing:
            self._snapshot = snapshot
            self._index = min(self._index, max(0, len(snapshot.cameras) - 1))
            self._display.draw(snapshot, self._index, self._losses, self._state())

    def _draw_state(self) -> None:
        with self._drawing:
            self._display.set_status(self._state())

    def _state(self) -> str:
        what = f"step {self._steps}" + (f", loss {self._losses[-1]:.3e}" if self._losses else "")
        return f"**paused** at {what}" if self.paused else f"**ended** at {what}" if self._ended else what

    def _label(self) -> None:
        self._display.set_labels("Resume" if self.paused else "Pause", "Close" if self._ended else "Stop")

    def _toggle(self) -> None:
        self.resume() if self.paused else self.pause()

    def _select_camera(self, index: int) -> None:
        """Show another camera, also while paused and after the end."""
        with self._drawing:
            self._index = index
            if self._snapshot is not None and self._display.url is not None:
                self._display.draw_panel(self._snapshot, index)  # pyright: ignore[reportAttributeAccessIssue]


def _loss(fit: object) -> float | None:
    """Return the last step's loss."""
    search = getattr(fit, "search", fit)
    history = getattr(search, "history", None)
    return getattr(history[-1] if history else fit, "loss", None)


def in_notebook() -> bool:
    """Return whether this process is a notebook's kernel."""
    try:
        from IPython import get_ipython  # pyright: ignore[reportMissingImports]
    except ImportError:
        return False
    return hasattr(get_ipython(), "kernel")

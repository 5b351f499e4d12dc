"""What the parts of the panel share: the viewer, the study that is worked on, the background."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from napari.layers import Layer as NapariLayer
from numpy.typing import NDArray
from qtpy.QtCore import QObject, Signal

from optical_palpation.errors import OpticalPalpationError
from optical_palpation.palpation.result import StressResult
from optical_palpation.viewer.background import Background
from optical_palpation.viewer.layers import KEY, Layer, map_layers, volume_layer
from optical_palpation.viewer.session import SIDES, Session

#: Maps of a comparison, and what they are called here; the one that is seen comes last.
_DIFFERENCE = {"difference_error": "error_of_it", "difference": "difference"}
#: Pixels of the canvas that a colour bar takes, with its numbers: downwards and to the left.
_COLOUR_BAR = 180, 80
#: Width of a letter of the caption beside it, pixels, and how many fit on a line at least.
_LETTER, _LEAST_LETTERS = 8, 12
#: Of sRGB, and the luminance on which black and white are read alike (WCAG's contrast).
_GAMMA, _LUMINANCE, _BRIGHT = 2.2, np.array([0.2126, 0.7152, 0.0722]), 0.18
_IN_VOLUMES = ("volume", "boundary", "anchors")
_FOUND = ("boundary", "anchors", "excluded")


class Workbench(QObject):
    """The viewer, the session and what they show of it."""

    #: Another study is worked on.
    opened = Signal()
    #: The layer was found in a volume; its side.
    found = Signal(str)
    #: There is a new stress.
    solved = Signal()
    #: Something to tell the user.
    said = Signal(str)

    def __init__(self, viewer: Any, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.viewer = viewer
        self.session = Session()
        self.background = Background(self)
        self.result: StressResult | None = None
        #: The layer as it is shown, by the volume it was found in.
        self.seen: dict[str, xr.Dataset] = {}

    def attempt(self, action: Callable[[str], object], path: str) -> bool:
        """Do something with a file that was chosen, if one was; tell the user what is wrong.

        Returns
        -------
        bool
            Whether nothing was wrong.
        """
        try:
            if path:
                action(path)
        except OpticalPalpationError as error:
            self.said.emit(str(error))
            return False
        return True

    def take_up(self, session: Session) -> None:
        """Work on another study, and show its volumes."""
        self.background.cancel()
        self.session = session
        self.result = None
        self.seen = {}
        with self.at_once():
            for side in SIDES:
                self.forget_found(side)
                given = session.input(side)
                if "volume" in given and self.volume_of(given["volume"]) is None:
                    self.show([volume_layer(session.open_volume(side), given["volume"])])
            self.opened.emit()

    def at_once(self) -> AbstractContextManager[None]:
        """Let layers come and go, and the canvas follow at the end.

        It would else be drawn anew, and garbage be collected, for each of them.
        """
        context: AbstractContextManager[None] = self.viewer.layers.batched_update()
        return context

    def layers(self, kind: str, side: str | None = None) -> Iterator[NapariLayer]:
        """Layers of this plugin, by kind and side."""
        for layer in self.viewer.layers:
            about = layer.metadata.get(KEY, {})
            if about.get("kind") == kind and (side is None or about.get("side") == side):
                yield layer

    def volume_of(self, file: str) -> NapariLayer | None:
        """The layer that shows a volume."""
        return next(
            (v for v in self.layers("volume") if v.metadata[KEY]["input"]["volume"] == file), None
        )

    def show(self, layers: Sequence[Layer]) -> list[NapariLayer]:
        """Show layers, in place of those of the same name."""
        shown = []
        for layer in layers:
            name = layer.keywords["name"]
            old = next((it for it in self.viewer.layers if it.name == name), None)
            if old is not None and layer.kind == "image" and old.metadata.get(KEY):
                _update(old, layer)
                shown.append(old)
                continue
            new = NapariLayer.create(layer.data, dict(layer.keywords), layer.kind)
            if old is not None:
                new.visible = old.visible
                place = self.viewer.layers.index(old)
                self.viewer.layers.remove(old)
                self.viewer.layers.insert(place, new)
            else:
                self.viewer.add_layer(new)
            if layer.kind == "image" and layer.keywords["metadata"][KEY]["kind"] == "map":
                new.colorbar.visible = True
                new.metadata[KEY]["limits"] = tuple(new.contrast_limits)
                new.events.visible.connect(lambda _: self._caption())
            shown.append(new)
        self._caption()
        return shown

    def _caption(self) -> None:
        """Write above the map that is seen what it is and its unit."""
        seen = [layer for layer in self.layers("map") if layer.visible]
        text = self.viewer.canvas.overlays.text
        text.position = "top_left"
        caption = seen[-1].metadata[KEY].get("caption", "") if seen else ""
        letters = max(_LEAST_LETTERS, int(self.viewer.canvas.size[1] - _COLOUR_BAR[1]) // _LETTER)
        text.text = "\n".join(textwrap.fill(line, letters) for line in caption.split("\n"))
        text.visible = bool(seen)
        self.ink_names()

    def ink_names(self) -> None:
        """Write the names of regions in black on what is bright of the map, in white on the rest.

        No one colour is read on all of a map.
        """
        seen = [layer for layer in self.layers("map") if layer.visible]
        for drawn in self.layers("regions"):
            if seen and len(drawn.data):
                at = [(np.min(it, 0) + np.max(it, 0)) / 2 for it in drawn.data]
                bright = _brightness(seen[-1], np.array(at)) > _BRIGHT
                drawn.text.color = np.where(bright, "black", "white").tolist()

    def show_difference(self, found: xr.Dataset) -> None:
        """Show the one difference of a comparison, and its error where it has one.

        Parameters
        ----------
        found
            As from :func:`~optical_palpation.analysis.compare_results`, of two results.
        """
        # an error is no difference to be coloured about zero
        fields = found.isel(compared=0, drop=True).rename(
            {name: new for name, new in _DIFFERENCE.items() if name in found}
        )
        other = str(found["compared"].values[0])
        layers = map_layers(fields, only=list(_DIFFERENCE.values()))
        for layer in layers:
            about = layer.keywords["metadata"][KEY]
            about |= {"comparison": True, "caption": f"{about['caption']}\n{other} less this"}
        with self.at_once():
            self.forget_difference()
            self.show(layers)
            self.raise_regions()
        self.view_maps([layers[-1].keywords["name"]])

    def forget_found(self, side: str) -> None:
        """Remove the boundaries of another volume, and what was drawn to correct them."""
        self.seen.pop(side, None)
        for kind in _FOUND:
            for layer in list(self.layers(kind, side)):
                self.viewer.layers.remove(layer)

    def hide_found(self, side: str) -> None:
        """Leave the boundaries of a volume to be looked at later."""
        for kind in _FOUND:
            for layer in self.layers(kind, side):
                layer.visible = False

    def forget_difference(self) -> None:
        """Remove the comparison, which is one with a stress that is no longer shown."""
        for layer in list(self.layers("map")):
            if layer.metadata[KEY].get("comparison"):
                self.viewer.layers.remove(layer)

    def raise_regions(self) -> None:
        """Put the regions over maps that were not there before."""
        layers = self.viewer.layers
        for drawn in list(self.layers("regions")):
            layers.move(layers.index(drawn), len(layers))

    def view_bscans(self, side: str) -> None:
        """Show the B-scans of a volume with what was found in it."""
        given = self.session.input(side)
        volume = self.volume_of(given["volume"]) if "volume" in given else None
        if volume is None:
            self.said.emit(f"the {side} layer is no volume: there are no B-scans")
            return
        self.view_volume(volume, side)

    def view_volume(self, volume: NapariLayer, side: str | None = None) -> None:
        """Show the B-scans of a volume, with what was found in it if it is that of a side."""
        dims = self.viewer.dims
        for layer in self.viewer.layers:
            about = layer.metadata.get(KEY, {})
            of_side = (side is not None and about.get("side") == side) or layer is volume
            layer.visible = about.get("kind") in _IN_VOLUMES and of_side
        dims.ndisplay = 2
        dims.order = (1, 0, 2)
        dims.set_current_step(1, volume.data.shape[1] // 2)
        self.viewer.scene.camera.orientation2d = ("down", "right")
        self.viewer.canvas.overlays.scale_bar.visible = True
        self.viewer.reset_view()

    def view_maps(self, names: Sequence[str] = (), first: str = "") -> None:
        """Show the maps en face; of these, the ones that are named alone, if any are.

        Where none was shown before, the stress is, or the one that is to come first.
        """
        for layer in self.viewer.layers:
            kind = layer.metadata.get(KEY, {}).get("kind")
            if kind in _IN_VOLUMES:
                layer.visible = False
            elif kind == "map" and names:
                layer.visible = layer.name in names
            elif kind in ("regions", "excluded"):
                layer.visible = True
        maps = [layer for layer in self.layers("map")]
        if maps and not any(layer.visible for layer in maps):
            there = [layer for layer in maps if layer.name == first and self.result is None]
            (there or maps)[-1].visible = True
        dims = self.viewer.dims
        dims.ndisplay = 2
        dims.order = tuple(range(dims.ndim))
        self.viewer.scene.camera.orientation2d = ("up", "right")  # as in all figures
        self.viewer.canvas.overlays.scale_bar.visible = True
        self.viewer.reset_view()
        self._leave_room()
        self._caption()

    def _leave_room(self) -> None:
        """Show the maps smaller where the colour bar would lie on their corner."""
        seen = [layer for layer in self.layers("map") if layer.visible]
        if not seen:
            return
        # from centre to centre, and half a pixel at either end
        size = np.max([np.ptp(it.extent.world, 0) + it.scale for it in seen], 0)
        room = np.array(self.viewer.canvas.size) - 2 * np.array(_COLOUR_BAR)
        if (room > 0).any():  # beside or below it, whichever is more
            camera = self.viewer.scene.camera
            camera.zoom = min(camera.zoom, float((room / size).max()))

    def title(self, given: Mapping[str, Any]) -> str:
        """What to call an input of a study."""
        if "thickness" in given:
            return f"{given['thickness']:g} mm"
        return Path(str(given.get("volume") or given.get("map") or "")).name


def _brightness(image: Any, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Luminance, 0 to 1, of a map as it is shown at places (n, 2) in mm."""
    pixels = np.round((places - image.translate) / image.scale).astype(int)
    row, column = np.clip(pixels, 0, np.array(image.data.shape) - 1).T
    low, high = image.contrast_limits
    shares = np.nan_to_num((image.data[row, column] - low) / (high - low))
    rgb = image.colormap.map(np.clip(shares, 0.0, 1.0))[:, :3]
    return np.asarray(rgb**_GAMMA @ _LUMINANCE)


def _update(old: Any, new: Layer) -> None:
    """Put new values into an image, whose limits stay if the user has chosen them."""
    chosen = tuple(old.contrast_limits) != old.metadata[KEY].get("limits")
    old.data = new.data
    old.scale, old.translate = new.keywords["scale"], new.keywords["translate"]
    if not chosen:
        limits = tuple(float(v) for v in new.keywords["contrast_limits"])
        low = min(limits[0], float(np.nanmin(new.data)))
        high = max(limits[1], float(np.nanmax(new.data)))
        old.contrast_limits_range = (low, high)
        old.contrast_limits = limits
        old.metadata[KEY]["limits"] = tuple(old.contrast_limits)

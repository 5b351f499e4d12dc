"""Missing values, scale and offset by the conventions of netCDF and CF, as samples are read.

xarray undoes ``scale_factor``, ``add_offset``, ``_FillValue``, ``missing_value`` and ``_Unsigned``.
What it leaves alone is done here, after the NetCDF User Guide: ``valid_range``, ``valid_min`` and
``valid_max``, and the values with which the netCDF library fills what nobody has written.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import Key

_RANGE = ("valid_range", "valid_min", "valid_max")
_NUMBERS = ("scale_factor", "add_offset", "_FillValue", "missing_value")
_FILLS = {"f4": 9.969209968386869e36, "f8": 9.969209968386869e36}
_INTEGER_FILLS = {"i2": -32767, "i4": -2147483647, "i8": -9223372036854775806}
_INTEGER_FILLS |= {"u2": 65535, "u4": 4294967295, "u8": 18446744073709551614}


class Decoded:
    """An array whose values are decoded block by block; NaN where one is missing.

    Parameters
    ----------
    base
        Stored values, read by slices.
    dims
        One name per axis.
    attrs
        Attributes of the array.
    fills
        Further values that stand for missing ones.
    by_netcdf
        Written by the netCDF library, whose own fill values then hold for integers as well.
    """

    def __init__(
        self,
        base: Any,
        dims: Sequence[str],
        attrs: Mapping[str, object],
        *,
        fills: Sequence[float] = (),
        by_netcdf: bool = False,
        where: str = "",
    ) -> None:
        self._base, self._dims, self._attrs = base, tuple(dims), dict(attrs)
        self.random_access: bool = getattr(base, "random_access", True)
        stored = np.dtype(base.dtype)
        for key in _NUMBERS:
            if key in attrs and np.asarray(attrs[key]).dtype.kind not in "iuf":
                raise InputError(f"{where}: {key} is {attrs[key]!r}, no number; store it as one")
        if stored.kind == "f":  # 0.1 in double precision equals no number in single precision
            for key in {"_FillValue", "missing_value"} & attrs.keys():
                self._attrs[key] = _as_stored(np.asarray(attrs[key]), stored)[()]
        self.shape: tuple[int, ...] = tuple(int(n) for n in base.shape)
        self.chunks = tuple(getattr(base, "chunks", None) or (1,) * len(self.shape))
        self._fills = list(fills)
        kind = stored.str[1:]
        if stored.kind in "iuf" and "_FillValue" not in attrs:
            known = _FILLS | (_INTEGER_FILLS if by_netcdf else {})
            self._fills += [known[kind]] if kind in known else []
        signs = {"true": f"u{stored.itemsize}", "false": f"i{stored.itemsize}"}
        sign = signs.get(str(attrs.get("_Unsigned")).lower()) if stored.kind in "iu" else None
        self._meant = np.dtype(sign) if sign else stored
        self._low, self._high, self._packed = _valid_range(attrs, stored, self._meant, where)
        unread = np.broadcast_to(np.zeros((), stored), (0,) * len(self.shape))
        decoded = self._by_xarray(unread)
        self.attrs = {key: value for key, value in decoded.attrs.items() if key not in _RANGE}
        self.dtype = decoded.dtype

    @property
    def _limited(self) -> bool:
        return np.isfinite(self._low) or np.isfinite(self._high)

    def _by_xarray(self, values: NDArray[Any]) -> Any:
        import xarray as xr

        raw = xr.Variable(self._dims, values, self._attrs)
        with warnings.catch_warnings():  # xarray's, where several values stand for missing ones
            warnings.simplefilter("ignore", xr.SerializationWarning)
            return xr.conventions.decode_cf_variable("values", raw, decode_times=False)

    def __getitem__(self, key: Key) -> NDArray[Any]:
        return self.decoded(np.asarray(self._base[key]))

    def decoded(self, raw: NDArray[Any]) -> NDArray[Any]:
        """Values of a block as it is stored."""
        values = np.asarray(self._by_xarray(raw).values)
        missing = np.zeros(raw.shape, bool)
        for fill in self._fills:
            missing |= raw == np.asarray(fill).astype(raw.dtype)
        if self._limited:
            compared = raw.astype(self._meant, copy=False) if self._packed else values
            missing |= (compared < self._low) | (compared > self._high)
        if missing.any():  # of whole numbers, floating-point ones
            values = values.astype(np.result_type(values.dtype, np.float32))
            values[missing] = np.nan
        return values


def _valid_range(
    attrs: Mapping[str, object], stored: np.dtype[Any], meant: np.dtype[Any], where: str
) -> tuple[float, float, bool]:
    """Lowest and highest valid value, and whether they are compared with the stored values.

    `meant` is the stored type with the sign that ``_Unsigned`` gives it.
    """
    both, low, high = (attrs.get(key) for key in _RANGE)
    limits = (
        both
        if both is not None
        else (
            -np.inf if low is None else low,
            np.inf if high is None else high,
        )
    )
    try:
        lowest, highest = (float(v) for v in np.ravel(np.asarray(limits)))
    except (TypeError, ValueError):
        raise InputError(f"{where}: valid_range, valid_min or valid_max are no numbers") from None
    kind = np.result_type(*(np.asarray(v).dtype for v in (both, low, high) if v is not None), "i1")
    scales = [np.asarray(attrs[k]).dtype for k in ("scale_factor", "add_offset") if k in attrs]
    # Of the type of the scale, and wider than what is stored: in unpacked units.
    unpacked = bool(scales) and stored.kind in "iu" and kind.kind == "f"
    if not unpacked and stored.kind == "f":
        lowest, highest = _as_stored(np.array([lowest, highest]), stored).tolist()
    elif meant != stored and kind.kind in "iu":  # the sign holds for the limits as well
        lowest, highest = (_wrapped(limit, meant) for limit in (lowest, highest))
    return lowest, highest, not unpacked


def _wrapped(limit: float, dtype: np.dtype[Any]) -> float:
    """A number of the other sign, as the bits of a type of integers mean it."""
    if not np.isfinite(limit):
        return limit
    info, span = np.iinfo(dtype), 2.0 ** (8 * dtype.itemsize)
    return limit + span * (int(limit < info.min) - int(limit > info.max))


def _as_stored(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Numbers as a floating-point type rounds them, but for those beyond its range."""
    with np.errstate(over="ignore"):
        rounded = values.astype(dtype)
    return np.where(np.isfinite(rounded) == np.isfinite(values), rounded, values)

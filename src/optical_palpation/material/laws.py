"""The laws by name."""

from __future__ import annotations

from typing import Literal, get_args

from optical_palpation.errors import MaterialError
from optical_palpation.material.law import Law
from optical_palpation.material.mooney_rivlin import MooneyRivlin
from optical_palpation.material.neo_hookean import NeoHookean
from optical_palpation.material.ogden import Ogden
from optical_palpation.material.yeoh import Yeoh

LawName = Literal["mooney-rivlin", "neo-hookean", "yeoh", "ogden"]
#: The laws that `make_law` and `fit_uniaxial` know.
LAWS: dict[str, type[Law]] = {law.name: law for law in (MooneyRivlin, NeoHookean, Yeoh, Ogden)}
assert tuple(LAWS) == get_args(LawName)


def neo_hookean(c10: float, bulk_to_shear: float = 1e4) -> NeoHookean:
    """Neo-Hookean law of coefficient c10, kPa; its shear modulus is 2 c10."""
    return NeoHookean(c10, bulk_to_shear)


def stable_stretches(c10: float, c01: float) -> tuple[float, float]:
    """Range of uniaxial stretch in which Mooney-Rivlin coefficients (kPa) are stable.

    See :meth:`Law.stable_stretches`.

    Raises
    ------
    MaterialError
        If ``c10 + c01`` is not positive: the law is unstable at rest.
    """
    if not c10 + c01 > 0.0:
        raise MaterialError(
            f"unstable material: c10 + c01 = {c10 + c01:g} kPa must be positive "
            f"(c10 = {c10:g} kPa, c01 = {c01:g} kPa)"
        )
    return MooneyRivlin.unchecked(c10, c01).stable_stretches()


def make_law(
    law: str = "mooney-rivlin", bulk_to_shear: float = 1e4, **parameters: float | None
) -> Law:
    """Return a law by its name and parameters, as the command line and study files give them.

    Parameters
    ----------
    law
        ``"mooney-rivlin"`` (c10, c01), ``"neo-hookean"`` (c10), ``"yeoh"`` (c10, c20, c30) or
        ``"ogden"`` (mu, alpha).
    bulk_to_shear
        Ratio of bulk to initial shear modulus.
    parameters
        Those of the law, kPa; None is as good as not given. c01, c20 and c30 are 0 by default.

    Raises
    ------
    MaterialError
        If there is no such law, a parameter is missing or belongs to another law, or the law cannot
        be that of a layer.
    """
    if law not in LAWS:
        raise MaterialError(f"law = {law!r}: choose one of {', '.join(LAWS)}")
    kind = LAWS[law]
    given = {name: value for name, value in parameters.items() if value is not None}
    optional = {"c01", "c20", "c30"}
    missing = [name for name in kind.parameters if name not in given and name not in optional]
    foreign = [name for name in given if name not in kind.parameters]
    # no coefficient, said aloud
    foreign = [name for name in foreign if name not in optional or given[name] != 0.0]
    if missing or foreign:
        wrong = [f"{name} is missing" for name in missing]
        wrong += [f"{name} belongs to another law" for name in foreign]
        raise MaterialError(f"the {law} law takes {', '.join(kind.parameters)}: {'; '.join(wrong)}")
    own = {name: given[name] for name in kind.parameters if name in given}
    return kind.of(own, bulk_to_shear)

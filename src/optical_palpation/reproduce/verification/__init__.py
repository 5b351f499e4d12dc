"""The verification page: the solver against closed forms and an independent code."""

from optical_palpation.reproduce.page import Chapter, Page
from optical_palpation.reproduce.verification.homogeneous import compression, manufactured
from optical_palpation.reproduce.verification.indentation import indentation
from optical_palpation.reproduce.verification.not_yet import not_yet
from optical_palpation.reproduce.verification.slabs import slabs
from optical_palpation.reproduce.verification.strips import strips
from optical_palpation.reproduce.verification.tangential import tangential
from optical_palpation.reproduce.verification.waves import waves

VERIFICATION = Page(
    name="verification",
    introduction="""\
# Verification

The solver against closed forms and an independent code. Errors are those of our numbers, from a
coarse to a fine mesh. This page and its pictures are made by

```text
optical-palpation reproduce --only verification --output docs --references tests/data/references
```

and `tests/test_verification.py` checks each part on small meshes. With `--check` the same command
changes nothing and compares every number with a fresh run: within 1 %, or a point of an error; the
exit status is 5 if one differs. Units: mm, kPa, mN. Unless said
otherwise the layer has $C_{10}$ = 2.23 kPa, $C_{01}$ = 0.703 kPa ($\\mu$ = 5.866 kPa) and
$K/\\mu$ = 10⁴; $h$ is its thickness, $E = 3 \\mu$.
""",
    columns=("source", "quantity", "exact", "ours, coarse to fine (error)", "remarks"),
    chapters={
        "compression": Chapter("Homogeneous compression: a patch test of contact", compression),
        "manufactured": Chapter("Manufactured solution at finite strain", manufactured),
        "waves": Chapter("Transfer function, sliding and stuck", waves),
        "indentation": Chapter("A paraboloid on thick and thin layers", indentation),
        "slabs": Chapter("Bonded and slipping slabs", slabs),
        "tangential": Chapter("Stick and slip under a tangential load", tangential),
        "strips": Chapter("Layers with a free side: an independent code", strips),
        "not-yet": Chapter("Not yet", not_yet),
    },
)

__all__ = ["VERIFICATION"]

"""Layers in plane strain by an independent code, NGSolve: references for the verification page.

    python benchmarks/references.py slab ridges --output tests/data/references

needs the package ngsolve, which the project itself does not. A Mooney-Rivlin layer (C10 2.23,
C01 0.703 kPa, K/mu 1e4) lies on a window, z = 0, and is pressed by a rigid imprint that moves from
z = L0 to z = L1(x), straight. Lengths in mm; the middle x = 0 is a plane of symmetry, x = 2.5
(stuck: 1.5) a free side; nothing changes along y. Friction coefficients at window and imprint:

    slab     L0 0.4769376, L1 0.2771394 everywhere, 0.12 and 0.05
    ridges   L0 0.5, L1 = 0.46 + 0.05 cos(2 pi x), 0.3 and 0.05
    step     L0 0.5, L1 = 0.43 - 0.04 tanh((1 - x) / 0.05), 0.15 and 0.05: the rim of a coin
    stuck    L0 0.5, L1 0.45 everywhere, glued to both
    cast     as ridges, but glued to the window

Triangles with quadratic displacement and linear continuous pressure (Taylor-Hood), of the energy
C10 (I1 - 3) + C01 (I2 - 3) + p (J - 1) - p^2 / 2K of the isochoric invariants. They become smaller
towards the corners of the free side. Window and imprint press faces and free side by a penalty at
integration points: a force N = S(stiffness x penetration) per reference length, vertical, and N
times the slope of the imprint sideways. Friction is that of the project's documentation, N f w /
(1 + w^4)^(1/4), w the slip in slip lengths (0.002 L0), carried over from load to load up to 5; it
acts on a free side that has rolled onto a face as on the face. Where Newton's method does not get
on, load steps are halved, and then the layer is moved through honey: a drag that is withdrawn.

Nothing is shared with the project's solver but the problem. Each case is solved on two meshes,
and on the first also with half the load steps, with a quarter of the stiffness of contact, and with
a quarter of the slip length, the last of which is another problem and says how much that matters.
The file holds the forces (of half the layer, mN per mm along y) and contact pressures.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from math import pi
from pathlib import Path
from typing import Any

import ngsolve as ng
import numpy as np
from netgen.geom2d import SplineGeometry

C10, C01, BULK_TO_SHEAR = 2.23, 0.703, 1e4
MU = 2 * (C10 + C01)
#: Elements of the thickness, and the size at the corners of the free side in thicknesses, on a
#: coarse and a fine mesh. Reliefs take many more iterations than flat imprints.
FLAT, RELIEF = ((6, 0.02), (12, 0.01)), ((4, 0.04), (6, 0.02))
#: Width of the bins in which the contact pressure is given, mm.
BIN = 0.1


@dataclass(frozen=True)
class Case:
    """A layer: L1 and its slope as expressions in x; friction, None for a face that is glued."""

    thickness: float
    half_width: float
    loaded: Callable[[Any], tuple[Any, Any]]
    friction: tuple[float | None, float | None]
    formula: str
    slip: float = 0.002
    stiffness: float = 1e6
    rubbing_side: bool = True
    meshes: tuple[tuple[int, float], ...] = RELIEF


def flat(height: float) -> Callable[[Any], tuple[Any, Any]]:
    return lambda x: (ng.CF(height), ng.CF(0.0))


def ridges(x: Any) -> tuple[Any, Any]:
    return 0.46 + 0.05 * ng.cos(2 * pi * x), -0.1 * pi * ng.sin(2 * pi * x)


def step(x: Any) -> tuple[Any, Any]:
    e = ng.exp(-2 * (1 - x) / 0.05)
    tanh = (1 - e) / (1 + e)
    return 0.43 - 0.04 * tanh, 0.8 * (1 - tanh * tanh)


CASES = {
    "slab": Case(
        0.4769376, 2.5, flat(0.2771394), (0.12, 0.05), "0.2771394", 0.002, 1e7, meshes=FLAT
    ),
    "ridges": Case(0.5, 2.5, ridges, (0.3, 0.05), "0.46 + 0.05 * cos(2 * pi * x)"),
    "step": Case(0.5, 2.5, step, (0.15, 0.05), "0.43 - 0.04 * tanh((1 - x) / 0.05)"),
    "stuck": Case(0.5, 1.5, flat(0.45), (None, None), "0.45", meshes=((5, 0.025), (10, 0.0125))),
    "cast": Case(0.5, 2.5, ridges, (None, 0.05), "0.46 + 0.05 * cos(2 * pi * x)"),
}


class NotConverged(Exception):
    """Newton's method did not converge."""


class Layer:
    """The discrete problem, and what follows the load."""

    def __init__(self, case: Case, elements: int, corner: float) -> None:
        self.case, self.eps = case, 2e-2 * MU
        self.slip_length = case.slip * case.thickness
        self.mesh = self._mesh(elements, corner)
        glued = [
            name for name, f in zip(("window", "imprint"), case.friction, strict=True) if f is None
        ]
        self.space = ng.VectorH1(
            self.mesh, order=2, dirichletx="|".join(["middle", *glued]), dirichlety="|".join(glued)
        ) * ng.H1(self.mesh, order=1)
        self.solution = ng.GridFunction(self.space)
        self.before = ng.GridFunction(self.space.components[0])
        self.load, self.drag = ng.Parameter(0.0), ng.Parameter(0.0)
        points = ng.comp.IntegrationRuleSpaceSurface(self.mesh, order=5)
        self.rules = points.GetIntegrationRules()
        #: Slip in slip lengths at the last load, in contact with window and imprint.
        self.memory = [ng.GridFunction(points), ng.GridFunction(points)]
        self.iterations = self.loads = self.drags = 0
        #: The equations, and the same with friction in proportion to the slip: for the matrix far
        #: from the solution, where Newton's method swings between both directions of friction.
        self.form: Any = None
        self.secant: Any = None
        self._form()

    def _mesh(self, elements: int, corner: float) -> ng.Mesh:
        a, h, size = self.case.half_width, self.case.thickness, self.case.thickness / elements
        geometry = SplineGeometry()
        at = [
            geometry.AppendPoint(*p, maxh=m)
            for p, m in (
                ((0, 0), size),
                ((a, 0), corner * h),
                ((a, h), corner * h),
                ((0, h), size),
            )
        ]
        for number, name in enumerate(("window", "side", "imprint", "middle")):
            ends = at[number], at[(number + 1) % 4]
            geometry.Append(["line", *ends], bc=name)
        return ng.Mesh(geometry.GenerateMesh(maxh=size, grading=0.25))

    def _normal(self, u: Any, face: int) -> tuple[Any, Any]:
        """Vertical force per reference length, and the slope of the surface that presses."""
        z, h = ng.y + u[1], self.case.thickness
        if face == 0:
            penetration, slope = -z, ng.CF(0.0)
        else:
            goal, slope = self.case.loaded(ng.x + u[0])
            penetration, slope = z - h - self.load * (goal - h), self.load * slope
        t = self.case.stiffness * penetration
        root = ng.sqrt(t * t + 4 * self.eps**2)
        return ng.IfPos(t, 0.5 * (root + t), 2 * self.eps**2 / (root - t)), slope

    def _slip(self, u: Any, face: int) -> Any:
        moved = (u[0] - self.before[0]) / self.slip_length
        return self.memory[face] + moved

    def _touching(self) -> list[tuple[str, int, float]]:
        """Boundaries, what they can touch, and friction there."""
        both = list(enumerate(self.case.friction))
        faces = [(("window", "imprint")[n], n, f) for n, f in both if f is not None]
        # a side that rolls onto a face to which the layer is glued slides there
        rubs = self.case.rubbing_side
        return faces + [("side", n, f if rubs and f is not None else 0.0) for n, f in both]

    def _form(self) -> None:
        (u, p), (v, _) = self.space.TnT()
        f = ng.Id(2) + ng.grad(u)
        volume = ng.Det(f)
        c = f.trans * f
        trace, square = ng.Trace(c) + 1, ng.InnerProduct(c, c) + 1
        i1 = trace * volume ** (-2 / 3)
        i2 = 0.5 * (trace * trace - square) * volume ** (-4 / 3)
        energy = C10 * (i1 - 3) + C01 * (i2 - 3) + p * (volume - 1)
        energy -= p * p / (2 * BULK_TO_SHEAR * MU)
        self.form, self.secant = (ng.BilinearForm(self.space, symmetric=False) for _ in range(2))
        for form, at in ((self.form, u.Trace()), (self.secant, self.solution.components[0])):
            form += ng.Variation(energy.Compile() * ng.dx)
            form += self.drag * ng.InnerProduct(u - self.before, v) * ng.dx
            for name, face, friction in self._touching():
                normal, slope = self._normal(u.Trace(), face)
                work = normal * (slope * v.Trace()[0] - v.Trace()[1] if face else v.Trace()[1])
                if friction:
                    w, known = self._slip(u.Trace(), face), self._slip(at, face)
                    growth = ng.sqrt(ng.sqrt(1 + known**4))
                    work -= friction * normal * w / growth * v.Trace()[0]
                form += (-work).Compile() * ng.ds(name, intrules=self.rules)

    def _hold(self) -> None:
        """Prescribe the displacement of an imprint that holds the layer."""
        if self.case.friction[1] is not None:
            return
        goal, held = self.case.loaded(ng.x)[0], ng.GridFunction(self.space.components[0])
        there = self.mesh.Boundaries("imprint")
        held.Set(ng.CF((0.0, self.load * (goal - self.case.thickness))), definedon=there)
        u = self.solution.components[0].vec.FV().NumPy()
        on = np.array(list(self.space.components[0].GetDofs(there)))
        u[on] = held.vec.FV().NumPy()[on]

    def balance(self, load: float, exact: bool, limit: int = 60) -> int:
        """Newton's method at a load with a line search; return the number of iterations.

        Unless ``exact``, friction is linearised by its secant far from the solution.

        Raises
        ------
        NotConverged
        """
        self.load.Set(load)
        self._hold()
        free, vec = self.space.FreeDofs(), self.solution.vec
        project = ng.Projector(free, True)
        residual, trial = vec.CreateVector(), vec.CreateVector()
        n = self.space.components[0].ndof

        def error(at: Any) -> float:
            self.form.Apply(at, residual)
            project.Project(residual)
            return float(np.linalg.norm(residual.FV().NumPy()))

        errors, size, near, matrix = [error(vec)], np.inf, 0.3 * self.slip_length, self.secant
        for count in range(1, limit + 1):
            if matrix is self.form and size > near:
                near *= 0.1  # that was too early
            matrix = self.form if exact or size < near else self.secant
            matrix.AssembleLinearization(vec)
            try:
                inverse = matrix.mat.Inverse(free, inverse="umfpack")
            except Exception as failure:  # NGSolve's own class, which it does not export
                raise NotConverged(str(failure)) from None
            error(vec)
            direction = (inverse * residual).Evaluate()
            size = float(np.abs(direction.FV().NumPy()[:n]).max())
            fraction = min(1.0, 0.2 * self.case.thickness / size) if size > 0 else 1.0
            for _ in range(8):
                trial.data = vec - fraction * direction
                after = error(trial)
                if np.isfinite(after) and after < (5.0 if count == 1 else 1.0) * max(errors[-4:]):
                    break
                fraction *= 0.5
            else:
                raise NotConverged(f"no step leads on at load {load:g}")
            vec.data = trial
            errors.append(after)
            self.iterations += 1
            if fraction == 1.0 and size < 1e-8:
                return count
        raise NotConverged(f"no convergence at load {load:g}")

    def follow(self, largest: float, smallest: float = 1e-3, tell: bool = False) -> None:
        """Load fully, with steps that shrink and grow."""
        load, width, earlier, earlier_load = 0.0, 0.02, None, 0.0
        start = self.solution.vec.CreateVector()
        while load < 1.0:
            goal = min(1.0, load + width)
            start.data = self.solution.vec
            if earlier is not None:  # straight on
                ratio = (goal - load) / (load - earlier_load)
                self.solution.vec.data = start + ratio * (start - earlier)
            try:
                try:
                    count = self.balance(goal, exact=True, limit=12)
                except NotConverged:
                    self.solution.vec.data = start
                    count = self.balance(goal, exact=False)
            except NotConverged as failure:
                self.solution.vec.data = start
                width *= 0.5
                if tell:
                    print(f"  {failure}; step {width:.4f}", flush=True)
                if width < smallest:
                    self._through_honey(goal, tell)
                    count, width = 99, 4 * smallest
                else:
                    continue
            if earlier is None:
                earlier = start.CreateVector()
            earlier.data, earlier_load, load = start, load, goal
            self.loads += 1
            self._remember()
            if tell:
                print(f"  load {load:.4f}: {count} iterations", flush=True)
            if count <= 8:
                width = min(largest, 1.5 * width)

    def _through_honey(self, goal: float, tell: bool) -> None:
        """Reach a load against drag, which is then withdrawn."""
        drag = 100 * MU / self.case.thickness**2
        for _ in range(60):
            kept = self.solution.vec.CreateVector()
            kept.data = self.solution.vec
            self.drag.Set(drag)
            try:
                self.balance(goal, exact=False)
            except NotConverged:
                self.solution.vec.data = kept
                drag *= 4
                continue
            self._remember()
            self.drags += 1
            drag *= 0.4
            if tell:
                print(f"  load {goal:.4f}, drag {drag:.1e}", flush=True)
            if drag < 1e-2 * MU / self.case.thickness**2:
                self.drag.Set(0.0)
                try:
                    self.balance(goal, exact=False)
                except NotConverged:
                    continue
                return
        self.drag.Set(0.0)
        raise NotConverged(f"stopped at load {goal:g}")

    def _remember(self) -> None:
        u = self.solution.components[0]
        for face, memory in enumerate(self.memory):
            w = self._slip(u, face)
            w = ng.IfPos(w - 5, 5.0, ng.IfPos(-5 - w, -5.0, w))
            touches = ng.IfPos(self._normal(u, face)[0] - 2 * self.eps, 1.0, 0.0)
            new = ng.GridFunction(memory.space)
            new.Interpolate(touches * w, definedon=self.mesh.Boundaries(".*"))
            memory.vec.data = new.vec
        self.before.vec.data = u.vec

    def _nodal_forces(self, name: str) -> np.ndarray:
        """Vertical forces of the imprint on the vertices of a boundary, mN / mm."""
        space = ng.H1(self.mesh, order=1)
        forces = ng.LinearForm(space)
        normal = self._normal(self.solution.components[0], 1)[0]
        # at the points at which it presses: between them a stiff penalty says nothing
        forces += normal * space.TestFunction() * ng.ds(name, intrules=self.rules)
        return forces.Assemble().vec.FV().NumPy().copy()

    def force(self) -> float:
        """Force on the imprint, mN / mm."""
        if self.case.friction[1] is not None:
            return float(self._nodal_forces("imprint|side").sum())
        residual, rigid = self.solution.vec.CreateVector(), ng.GridFunction(self.space)
        self.form.Apply(self.solution.vec, residual)
        there = self.mesh.Boundaries("imprint")
        rigid.components[0].Set(ng.CF((0.0, 1.0)), definedon=there)
        return float(self._nodal_forces("side").sum() - ng.InnerProduct(residual, rigid.vec))

    def pressures(self) -> tuple[list[float], list[float]]:
        """Mean contact pressure of the imprint in bins of deformed x: upper bounds, and kPa.

        There are none where it is glued.
        """
        if self.case.friction[1] is None:
            return [], []
        u = self.solution.components[0]
        a, h = self.case.half_width, self.case.thickness
        forces = self._nodal_forces("imprint")
        vertices = sorted(
            (self.mesh[v].point[0], v.nr)
            for v in {
                v for e in self.mesh.Elements(ng.BND) if e.mat == "imprint" for v in e.vertices
            }
        )
        x = np.array([position for position, _ in vertices])
        nearly = 1 - 1e-12
        moved = x + [u(self.mesh(min(v, a * nearly), h * nearly))[0] for v in x]
        total = np.cumsum([forces[number] for _, number in vertices])
        middles = np.concatenate([moved[:1], 0.5 * (moved[1:] + moved[:-1]), moved[-1:]])
        bounds = np.arange(0.0, moved[-1], BIN)
        upto = np.interp(bounds, middles, np.concatenate([[0.0], total]))
        return list(bounds[1:]), list(np.diff(upto) / BIN)

    def bulge(self) -> float:
        """Largest x of the free side, mm."""
        u, a = self.solution.components[0], self.case.half_width
        depths = np.linspace(0, self.case.thickness, 201)[1:-1]
        return max(a + u(self.mesh(a * (1 - 1e-12), z))[0] for z in depths)


def solved(case: Case, mesh: tuple[int, float], largest: float) -> Layer:
    """The fully loaded layer; ``largest`` is the longest load step."""
    layer = Layer(case, *mesh)
    layer.follow(largest)
    return layer


def reference(name: str, largest: float) -> dict[str, Any]:
    """Everything that the file of a case says."""
    case = CASES[name]
    forces, seconds, counts = [], [], []
    for mesh in case.meshes:
        started = time.perf_counter()
        layer = solved(case, mesh, largest)
        seconds.append(round(time.perf_counter() - started, 1))
        forces.append(layer.force())
        counts.append((layer.loads, layer.iterations, layer.drags))
        print(
            f"{name} {mesh}: {forces[-1]:.6g} mN/mm, {layer.space.ndof} unknowns, {layer.loads} "
            f"loads, {layer.iterations} iterations, {layer.drags} drags, {seconds[-1]} s",
            flush=True,
        )
    softer = replace(case, stiffness=0.25 * case.stiffness)
    changes = {
        "half_the_load_steps": solved(case, case.meshes[0], 0.5 * largest),
        "a_quarter_of_the_contact_stiffness": solved(softer, case.meshes[0], largest),
    }
    if any(case.friction):
        shorter = replace(case, slip=0.25 * case.slip)
        changes["a_quarter_of_the_slip_length"] = solved(shorter, case.meshes[0], largest)
        slippery = replace(case, rubbing_side=False)
        changes["no_friction_on_the_free_side"] = solved(slippery, case.meshes[0], largest)
    print({what: other.force() / forces[0] - 1 for what, other in changes.items()}, flush=True)
    bounds, pressure = layer.pressures()
    return {
        "made_by": f"python benchmarks/references.py {name} --largest {largest:g} --output "
        "tests/data/references",
        "codes": {code: version(code) for code in ("ngsolve", "netgen-mesher")},
        "element": "Taylor-Hood P2-P1, plane strain",
        "c10_kPa": C10,
        "c01_kPa": C01,
        "bulk_to_shear": BULK_TO_SHEAR,
        "thickness_mm": case.thickness,
        "half_width_mm": case.half_width,
        "loaded_thickness_mm": case.formula,
        "window_friction": "glued" if case.friction[0] is None else case.friction[0],
        "sample_friction": "glued" if case.friction[1] is None else case.friction[1],
        "slip_length_mm": case.slip * case.thickness,
        "contact_stiffness_kPa_per_mm": case.stiffness,
        "elements_over_thickness": [n for n, _ in case.meshes],
        "element_size_at_the_corners_mm": [c * case.thickness for _, c in case.meshes],
        "longest_load_step": largest,
        "loads_iterations_and_steps_against_drag": counts,
        "seconds": seconds,
        "force_of_half_the_layer_mN_per_mm": forces,
        "relative_change_of_force_on_the_first_mesh_with": {
            what: other.force() / forces[0] - 1 for what, other in changes.items()
        },
        "bulge_mm": layer.bulge(),
        "pressure_bin_ends_mm": [round(b, 6) for b in bounds],
        "contact_pressure_kPa": [float(f"{p:.6g}") for p in pressure],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("case", nargs="+", choices=list(CASES))
    parser.add_argument("--output", type=Path, required=True, help="folder of the references")
    parser.add_argument("--largest", type=float, default=0.04, help="longest load step")
    arguments = parser.parse_args()
    ng.SetNumThreads(1)
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name in arguments.case:
        path = arguments.output / f"{name}.json"
        path.write_text(
            json.dumps(reference(name, arguments.largest), indent=1) + "\n", encoding="utf-8"
        )
        print(path)


if __name__ == "__main__":
    main()

"""C source of the Newton system of a density: FFCx differentiates, `point.c` does the rest."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import basix.ufl
import ffcx
import ffcx.analysis
import ffcx.codegeneration.codegeneration
import ffcx.ir.representation
import ffcx.options
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.algorithms import expand_derivatives
from ufl.core.expr import Expr

from solvers.engine.density import Density
from solvers.engine.slots import POINT, PointFunction

Pattern = npt.NDArray[np.bool_]

_DENSE_H, *_POINT_C = (Path(__file__).parent / name for name in ("dense.h", "point.c", "relax.c"))


class Source:
    """C source for a density, made when it is asked for.

    Attributes:
        sizes: The macros that `point.c` names.
        arguments: What its EACH_ARGUMENT goes through.
        local: What its EACH_LOCAL goes through.
        key: Stands for all that the source depends on.
    """

    def __init__(self, density: Density, fields: Sequence[fem.Function]) -> None:
        """Number the unknowns of a point.

        Args:
            density: The density.
            fields: The fields of the problem.
        """
        self._density = density
        unknowns = density.unknowns
        ends = np.cumsum([0, *(s.size for s in unknowns)]).tolist()
        self._place = dict(zip(unknowns, ends, strict=False))
        self._multiplied = [f for f in density.functions if f.unit is None and not f.frozen]
        self.local = [(fields.index(s.source), s.size, self._place[s]) for s in density.local]
        d = fields[0].function_space.mesh.geometry.dim
        self.arguments = []
        first = basis = shared = 0
        for f in dict.fromkeys(s.source for s in density.arguments):
            at = {s.gradient: self._place[s] for s in density.arguments if s.source is f}
            bs, nodes = f.function_space.dofmap.bs, f.function_space.dofmap.list.shape[1]
            places = first, at.get(False, -1), at.get(True, -1), basis
            self.arguments.append((fields.index(f), bs, nodes, *places))
            first, basis = first + bs * nodes, basis + nodes * (1 + d)
            if any(s.source is f for s in density.shared):
                shared = first
        NA, NL, NR, DATA = (
            sum(s.size for s in slots)
            for slots in (density.arguments, density.local, density.functions, density.data)
        )
        self.sizes = {
            "DIM": d,
            "POINTS": len(density.points[1]),
            "FIELDS": len(fields),
            "DATA": DATA,
            "NA": NA,
            "NL": NL,
            "NR": NR,
            "NZ": NA + NL,
            "NY": NA + NL + NR,
            "NS": shared,
            "NC": first - shared,
            "NE": first,
            "COLUMNS": 4 * (NA // 4 + 1),  # NA + 1, rounded up
            "WIDTH": 4 * (first // 4 + 1),
            "SHARED": sum(row[3] < shared for row in self.arguments),
            "MULTIPLIERS": sum(len(f.entries) for f in self._multiplied),
            "RANK": max([1, *(f.rank for f in density.functions)]),
        }
        self.sizes["KEPT"] = (
            2 * NR + self.sizes["MULTIPLIERS"] + sum(f.kept for f in density.functions)
        )
        self._forms = self._make_forms()
        texts = [
            path.read_text("utf-8") for path in (_DENSE_H, *_POINT_C, Path(__file__), *self._codes)
        ]
        layout: list[Any] = [self.sizes, self.arguments, self.local]
        layout += [
            [f.stem, f.frozen, f.linear, f.parameters, self._first(f)] for f in density.functions
        ]
        signatures = [form.signature() for form in self._forms.values()]
        everything = "\n".join([ffcx.__version__, repr(layout), *signatures, *texts])
        self.key = hashlib.sha256(everything.encode()).hexdigest()

    @property
    def _codes(self) -> list[Path]:
        return sorted({f.code for f in self._density.functions if f.code})

    def _first(self, f: PointFunction) -> int:
        """The place of the unknowns that an argument changes with, 0 where that is no slot."""
        return self._place[f.unit] if f.unit else 0

    def _make_forms(self) -> dict[str, ufl.Form]:
        """What FFCx is to compile, by the name that `point.c` has for it."""
        density = self._density
        vectors = {f: _vector(len(f.entries)) for f in self._multiplied}
        y, parts = _together(s.element for s in density.unknowns)
        data = [*(s.coefficient for s in density.data), *vectors.values()]
        data_parts = _together(c.ufl_element() for c in data)[1] if data else []
        renamed: dict[Expr, Expr] = dict(
            zip(
                [*(s.coefficient for s in density.unknowns), *data],
                [*parts, *data_parts],
                strict=True,
            )
        )
        renamed |= _as_one(list(density.constants.values()))
        dx = ufl.dx(degree=0, domain=POINT)
        v, dy = ufl.TestFunction(y.ufl_function_space()), ufl.TrialFunction(y.ufl_function_space())
        forms = {"ENERGY": density.expression * dx}
        whole = density.expression
        for k, f in enumerate(density.functions):
            test = ufl.TestFunction(_vector(len(f.entries)).ufl_function_space())
            forms[f"ARGUMENT_{k}"] = sum(a * test[i] for i, a in enumerate(f.entries)) * dx
            if f in vectors and not f.linear:
                whole += sum(vectors[f][i] * a for i, a in enumerate(f.entries))
        forms = {name: ufl.replace(form, renamed) for name, form in forms.items()}
        for k, f in enumerate(density.functions):
            if f in vectors:
                forms[f"JACOBIAN_{k}"] = ufl.derivative(forms[f"ARGUMENT_{k}"], y, dy)
        forms["GRADIENT"] = ufl.derivative(forms["ENERGY"], y, v)
        gradient = ufl.derivative(ufl.replace(whole, renamed) * dx, y, v)
        forms["HESSIAN"] = ufl.derivative(gradient, y, dy)
        self._y = y
        return {name: expand_derivatives(form) for name, form in forms.items()}

    def text(self) -> str:
        """Return the source; takes about a second."""
        options = ffcx.options.get_options({"scalar_type": np.float64})
        forms = {name: form for name, form in self._forms.items() if not form.empty()}
        analysis = ffcx.analysis.analyze_ufl_objects(list(forms.values()), np.float64)
        ir = ffcx.ir.representation.compute_ir(analysis, {}, "point", options, False)
        blocks, _ = ffcx.codegeneration.codegeneration.generate_code(ir, options)
        calls = dict.fromkeys(self._forms, "")
        moved: dict[str, set[int]] = {}  # which unknowns an argument changes with
        NY = self.sizes["NY"]
        coupled: Pattern = np.zeros((NY, NY), dtype=bool)
        for name, data, integral in zip(forms, analysis.form_data, ir.integrals, strict=True):
            # FFCx packs the coefficients that a form has; data come after the unknowns.
            start = "(y)" if self._y in data.reduced_coefficients else "(y) + NY"
            function = f"tabulate_tensor_{integral.expression.name}_interval"
            calls[name] = f"{function}(A, {start}, c, unit_interval, 0, 0, 0)"
            (contents,) = integral.expression.integrand.values()
            blocks_of = contents["block_contributions"]
            if name == "HESSIAN":
                for rows, columns in blocks_of:
                    coupled[np.ix_(rows, columns)] = True
            elif name.startswith("JACOBIAN"):
                moved[name] = {int(q) for _, columns in blocks_of for q in columns}
        macros = [f"#define {name} {value}" for name, value in self.sizes.items()]
        macros += [f"#define {name}(A, y, c) {call}" for name, call in calls.items()]
        for each, rows in (("EACH_ARGUMENT", self.arguments), ("EACH_LOCAL", self.local)):
            calls_of_X = " ".join(f"X({', '.join(map(str, row))})" for row in rows)
            macros.append(f"#define {each}(X) {calls_of_X}")
        return "\n".join(
            [
                *(code for _, code in blocks.file_pre),
                *macros,
                "static const double unit_interval[6] = {0, 0, 0, 1, 0, 0};",
                *(
                    re.sub(r"^void", "static void", code, flags=re.M)
                    for _, code in blocks.integrals
                ),
                *(path.read_text("utf-8") for path in self._codes),
                _DENSE_H.read_text("utf-8"),
                *self._functions(coupled, moved),
                *self._elimination(coupled),
                *(path.read_text("utf-8") for path in _POINT_C),
            ]
        )

    def _functions(self, coupled: Pattern, moved: dict[str, set[int]]) -> list[str]:
        """Tables and loops for functions; adds to `coupled` what they couple."""
        tables, values, pulls, chains = [], [], [], []
        # What comes through a linear function has a vector of its own, and no second derivative.
        linear = any(f.linear for f in self._density.functions)
        kept, multiplier = 2 * self.sizes["NR"], self.sizes["NY"] + self.sizes["DATA"]
        kept_of: dict[tuple[Path | None, Expr], str] = {}
        for k, f in enumerate(self._density.functions):
            n, r, rank, first = f.size, self._place[f], f.rank, self._first(f)
            m = len(f.entries)
            if not f.stem:
                values.append(f"for (int i = 0; i < {n}; i++) y[{r}+i] = 0;")
                values.append(f"ARGUMENT_{k}(y + {r}, y, c);")
            if f.frozen:
                continue
            start = end = ""
            if not f.unit:
                start = f"double J[{m}*NY] = {{0}}; JACOBIAN_{k}(J, y, c); "
            where = f"{r}, {n}, {rank}, {first}, {m}, {'0' if f.unit else 'J'}"
            derivatives, second = "0, 0", "0, 0"
            if f.stem:
                own = f"parameters_{k}, y + {r}, kept + {kept}"
                values.append(f"{{ double a[{m}] = {{0}}; ARGUMENT_{k}(a, y, c);")
                like = kept_of.get((f.code, f.argument), "0")
                kept_of[f.code, f.argument] = f"kept + {kept}"
                values.append(
                    f"  {f.stem}_value(parameters_{k}, a, y + {r}, kept + {kept}, {like}); }}"
                )
                start += f"double G[{n * rank}], L[{m * rank}]; {f.stem}_first({own}, G, L); "
                end = (
                    f"double C[{rank**2}], E[{m * rank}];"
                    f" {f.stem}_second({own}, kept + NR + {r} - NZ, C, E); "
                )
                derivatives, second = "G, L", "C, E"
                parameters = _braces(f.parameters)
                tables.append(f"static const double parameters_{k}[] = {parameters};")
            multipliers = "own" if f.unit else f"y + {multiplier}"
            pull = f"{where}, {derivatives}"
            if f.linear:
                pull = (
                    f"for (int i = 0; i < {n}; i++)"
                    f" {{ once[{r}+i] += g[{r}+i]; ({multipliers})[i] = 0; }}"
                    f" pull_back(once, {pull}, own);"
                )
            elif linear:
                pull = f"pull_back(once, {pull}, own); pull_back(g, {pull}, {multipliers});"
            else:
                pull = f"pull_back(g, {pull}, {multipliers});"
            pulls.append(f"{{ {start}double own[{m}]; {pull} }}")
            chains.append(
                f"{{ {start}{end}chain(H, rows_{k}, {where}, {derivatives}, {second}); }}"
            )
            kept += f.kept
            multiplier += 0 if f.unit else m
        # The last function first, whose argument may have others in it.
        for k, f in reversed(list(enumerate(self._density.functions))):
            if not f.frozen:
                r, first = self._place[f], self._first(f)
                rows = coupled[:, r : r + f.size].any(axis=1)
                changes = np.array(sorted(moved.get(f"JACOBIAN_{k}", ())), dtype=np.int64)
                if f.unit:
                    changes = np.arange(first, first + f.size)
                reached = np.union1d(np.flatnonzero(rows[:r]), changes)
                coupled[np.ix_(reached, changes)] = coupled[np.ix_(changes, reached)] = True
                tables.append(f"static const unsigned char rows_{k}[] = {_braces(1 * rows)};")
        pattern = "static inline void {}(double *{}, double *y, const double *c, double *kept) {{"
        return [
            *tables,
            "static inline void functions(double *y, const double *c, double *kept) {",
            *values,
            "}",
            pattern.format("pull_back_functions", "g"),
            *(["double once[NY] = {0};"] if linear else []),
            *reversed(pulls),
            *(["for (int i = 0; i < NZ; i++) g[i] += once[i];"] if linear else []),
            "}",
            pattern.format("chain_functions", "H"),
            *reversed(chains),
            "}",
        ]

    def _elimination(self, coupled: Pattern) -> list[str]:
        """Tables for the elimination of local unknowns."""
        NA, NL = self.sizes["NA"], self.sizes["NL"]
        block = coupled[NA : NA + NL, NA : NA + NL]
        with_arguments = np.flatnonzero(coupled[NA : NA + NL, :NA].any(axis=1))
        # Unknowns coupled with a single other one and not with themselves, and that one.
        multipliers = [i for i in range(NL) if block[i].sum() == 1 and not block[i, i]]
        strains = [int(np.flatnonzero(block[i])[0]) for i in multipliers]
        if len(set(strains)) < len(strains) or set(strains) & set(multipliers):
            strains, multipliers = [], []
        paired = strains + multipliers
        others = sorted(set(range(NL)) - set(paired))
        local = [f for f, size, _ in self.local for _ in range(size)]
        cellwise = [
            f
            for f, bs, nodes, first, *_ in self.arguments
            if first >= self.sizes["NS"]
            for _ in range(bs * nodes)
        ]
        shared = [row[:4] for row in self.arguments if row[3] < self.sizes["NS"]]
        return [
            f"#define PAIRS {len(strains)}",
            f"#define OTHERS {len(others)}",
            f"static const int strain[] = {_braces(strains)};",
            f"static const int multiplier[] = {_braces(multipliers)};",
            f"static const int paired[] = {_braces(paired)};",
            f"static const int other[] = {_braces(others)};",
            f"#define COUPLED {len(with_arguments)}",
            f"static const int coupled[] = {_braces(with_arguments)};",
            f"static const int local_field[] = {_braces(local)};",
            f"static const int cellwise_field[] = {_braces(cellwise)};",
            "static const struct { int field, components, nodes, first; } shared[] = "
            f"{{{', '.join(map(_braces, shared))}}};",
        ]


def _vector(size: int) -> ufl.Coefficient:
    element = basix.ufl.element("DG", "interval", 0, shape=(size,))
    return ufl.Coefficient(ufl.FunctionSpace(POINT, element))


def _together(elements: Iterable[Any]) -> tuple[ufl.Coefficient, Sequence[Expr]]:
    """One coefficient of several elements, and its parts."""
    mixed = basix.ufl.mixed_element(list(elements))
    whole = ufl.Coefficient(ufl.FunctionSpace(POINT, mixed))
    return whole, ufl.split(whole)


def _as_one(constants: Sequence[ufl.Constant]) -> dict[Expr, Expr]:
    """Each constant as a part of one vector, in order."""
    ends = np.cumsum([0, *(int(np.prod(c.ufl_shape)) for c in constants)]).tolist()
    whole = ufl.Constant(POINT, (max(ends[-1], 1),))
    parts: dict[Expr, Expr] = {}
    for c, first in zip(constants, ends, strict=False):
        shape = c.ufl_shape
        numbers = np.arange(first, first + int(np.prod(shape))).reshape(shape)
        parts[c] = ufl.as_tensor(_nested(whole, numbers.tolist())) if shape else whole[first]
    return parts


def _nested(whole: ufl.Constant, numbers: Any) -> Any:
    if isinstance(numbers, list):
        return [_nested(whole, n) for n in numbers]
    return whole[numbers]


def _braces(numbers: Iterable[float]) -> str:
    return "{" + (", ".join(repr(x) for x in np.asarray(list(numbers)).tolist()) or "0") + "}"

"""Write the quadrotor's derivative as scalar Python for numba, from the CasADi expression itself.

The model is written once, in CasADi; this walks its instruction stream and prints one line of Python for
each. Run ``python -m napf_mpc.vehicle.codegen`` after any change of the model.
"""

from __future__ import annotations

from pathlib import Path

import casadi as ca

from napf_mpc.vehicle.quadrotor import derivative_function

_TARGET = Path(__file__).with_name("derivative_generated.py")
_ARGUMENTS = ("x", "u", "p")

_EXPRESSIONS = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_SQRT: "sqrt({0})",
    ca.OP_SIN: "sin({0})",
    ca.OP_COS: "cos({0})",
    ca.OP_TAN: "tan({0})",
}

_HEADER = '''"""State derivative of the quadrotor as scalar code. Generated: do not edit.

Written by ``python -m napf_mpc.vehicle.codegen`` from :func:`napf_mpc.vehicle.quadrotor.derivative_function`.
"""

from __future__ import annotations

from math import {functions}

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled_bare


@compiled_bare
def derivative(
    x: NDArray[np.float64], u: NDArray[np.float64], p: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write the rate of the state x (12,) under input u (4,) and parameters p (4,) into out (12,)."""
'''


def generate(function: ca.Function | None = None) -> str:
    """Return the source of ``derivative_generated.py`` for a CasADi function ``(x, u, p) -> dx``.

    Every work slot of CasADi's virtual machine becomes a fresh local name each time it is written, so the
    text is in single-assignment form, does the same operations in the same order, and is the same for the
    same CasADi version.

    Parameters
    ----------
    function : casadi.Function, optional
        A scalar-expression (SX) function with inputs x, u, p and one dense output; by default the model.

    Raises
    ------
    ValueError
        The function holds an operation that has no scalar form here.
    """
    source = derivative_function() if function is None else function
    local: dict[int, str] = {}
    lines: list[str] = []
    used: set[str] = set()
    for index in range(source.n_instructions()):
        operation = source.instruction_id(index)
        inputs, outputs = source.instruction_input(index), source.instruction_output(index)
        if operation == ca.OP_OUTPUT:
            lines.append(f"out[{outputs[1]}] = {local[inputs[0]]}")
            continue
        name = f"w{index}"
        if operation == ca.OP_INPUT:
            text = f"{_ARGUMENTS[inputs[0]]}[{inputs[1]}]"
        elif operation == ca.OP_CONST:
            text = repr(float(source.instruction_constant(index)))
        elif operation in _EXPRESSIONS:
            pattern = _EXPRESSIONS[operation]
            text = pattern.format(*(local[slot] for slot in inputs))
            if "(" in pattern:
                used.add(pattern.partition("(")[0])
        else:
            raise ValueError(f"{source.name()}: operation {operation} (line {index}) has no scalar form")
        lines.append(f"{name} = {text}")
        local[outputs[0]] = name
    body = "".join(f"    {line}\n" for line in lines)
    return _HEADER.format(functions=", ".join(sorted(used))) + body


def main() -> None:
    """Write the generated module next to this one."""
    _TARGET.write_text(generate(), encoding="utf-8")
    print(f"wrote {_TARGET.name}: {derivative_function().n_instructions()} instructions")


if __name__ == "__main__":
    main()

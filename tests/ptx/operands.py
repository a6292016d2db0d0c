"""Operands of PTX instructions, as expressions of C."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ptx.translate import Function


class UnknownPtxError(NotImplementedError):
    """Something of PTX that is not translated."""


_SPECIAL = {
    "%tid.x": "t->tid",
    "%ctaid.x": "t->ctaid[0]",
    "%ctaid.y": "t->ctaid[1]",
    "%ctaid.z": "t->ctaid[2]",
    "%ntid.x": "t->launch->block",
    "%nctaid.x": "t->launch->grid[0]",
    "%nctaid.y": "t->launch->grid[1]",
    "%nctaid.z": "t->launch->grid[2]",
    "%laneid": "(t->tid & 31)",
    "%tid.y": "0u",
    "%tid.z": "0u",
    "%ntid.y": "1u",
    "%ntid.z": "1u",
}


def refuse_others(name: str, modifiers: list[str], known: set[str] | None = None) -> None:
    """Raise UnknownPtxError where there are modifiers that are not known."""
    if set(modifiers) - (known or set()):
        raise UnknownPtxError(".".join([name, *modifiers]))


def split(text: str) -> list[str]:
    """Return operands: what commas separate, but for those within brackets and braces."""
    return [part.strip() for part in re.split(r",(?![^{\[]*[}\]])", text) if part.strip()]


def is_float(kind: str) -> bool:
    return kind in {"f32", "f64"}


def width_of(kind: str) -> int:
    return 1 if kind == "pred" else int(kind[1:])


def c_type(kind: str) -> str:
    return kind.replace("b", "u") if kind != "pred" else "pred"


def name_of(register: str) -> str:
    """Return a register's name in C."""
    return "R" + register[1:]


def read(operand: str, kind: str, function: Function) -> str:
    """Return an operand's value as an expression of a type."""
    if operand in _SPECIAL:
        return f"(({c_type(kind)}){_SPECIAL[operand]})"
    held = function.registers.get(operand)
    if held is not None:
        return _read_register(name_of(operand), held, kind)
    if re.fullmatch(r"0[fF][0-9a-fA-F]{8}", operand):
        value = f"bits_f32(0x{operand[2:]}u)"
        return value if kind == "f32" else f"0x{operand[2:]}u"
    if re.fullmatch(r"0[dD][0-9a-fA-F]{16}", operand):
        value = f"bits_f64(0x{operand[2:]}ull)"
        return value if kind == "f64" else f"0x{operand[2:]}ull"
    if re.fullmatch(r"-?(0[xX][0-9a-fA-F]+|\d+)U?", operand):
        number = int(operand.removesuffix("U"), 0)
        return f"(({c_type(kind)})0x{number & (2**64 - 1):x}ull)"
    return f"(({c_type(kind)}){address_of(operand, function)})"


def _read_register(name: str, held: str, kind: str) -> str:
    """Return a register that holds one type as another: the same bits, or the lowest of them."""
    if held == c_type(kind):
        return name
    if is_float(kind) != is_float(held) and width_of(held) == width_of(kind):
        return f"bits_{kind}((u{width_of(kind)}){name})" if is_float(kind) else f"(({c_type(kind)}){held}_bits({name}))"
    if is_float(kind) or is_float(held):
        raise UnknownPtxError(f"{name} of type {held}, read as {kind}")
    return f"(({c_type(kind)}){name})"


def address_of(name: str, function: Function) -> str:
    """Return a variable's address in its own space."""
    name, _, offset = name.partition("+")
    more = f" + {int(offset)}" if offset else ""
    if name in function.pointers:
        return f"({function.pointers[name]}{more})"
    if name in function.params:
        return f"(param + {function.params[name]}{more})"
    if name in function.shared:
        return f"({function.shared[name]}u{more})"
    if name in function.locals:
        return f"(t->local + {function.locals[name]}{more})"
    if name in function.globals:
        function.used.add(name)
        return f"((u64){name}{more})"
    raise UnknownPtxError(f"operand {name}")


def write(register: str, kind: str, value: str, function: Function) -> str:
    """Return the assignment of a value of a type to a register."""
    if register == "_":
        return f"(void)({value});"
    held = function.registers.get(register)
    if held is None:
        raise UnknownPtxError(f"destination {register}")
    if held == c_type(kind) or is_float(held) == is_float(kind):
        if kind[0] == "s" and width_of(held) > width_of(kind):
            return f"{name_of(register)} = ({held})(s{width_of(held)})({value});"
        return f"{name_of(register)} = ({held})({value});"
    if is_float(kind):
        return f"{name_of(register)} = {kind}_bits({value});"
    return f"{name_of(register)} = bits_{held}(({c_type('u' + held[1:])})({value}));"

"""PTX instructions on the bits of words, as statements of C."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ptx.operands import UnknownPtxError, c_type, read, refuse_others, width_of, write

if TYPE_CHECKING:
    from ptx.translate import Function


def logic(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return and, or, xor."""
    kind = modifiers[-1]
    refuse_others(operation, modifiers[:-1])
    sign = {"and": "&", "or": "|", "xor": "^"}[operation]
    a, b = (read(o, kind, function) for o in operands[1:3])
    return write(operands[0], kind, f"({a} {sign} {b})", function)


def shift(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return shl, shr."""
    kind = modifiers[-1]
    refuse_others(operation, modifiers[:-1])
    name = f"shl_{width_of(kind)}" if operation == "shl" else f"shr_{c_type(kind)}"
    value = f"{name}({read(operands[1], kind, function)}, {read(operands[2], 'u32', function)})"
    return write(operands[0], kind, value, function)


def find_bit(modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return bfind."""
    kind = modifiers[-1]
    refuse_others("bfind", modifiers[:-1], {"shiftamt"})
    value = f"bfind_{c_type(kind)}({read(operands[1], kind, function)})"
    if "shiftamt" in modifiers:
        value = f"shifted({value}, {width_of(kind)})"
    return write(operands[0], "u32", value, function)


def field(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return bfi, bfe."""
    kind = modifiers[-1]
    refuse_others(operation, modifiers[:-1])
    count = 2 if operation == "bfi" else 1
    values = [read(o, kind, function) for o in operands[1 : 1 + count]]
    values += [read(o, "u32", function) for o in operands[1 + count :]]
    name = f"bfi_{width_of(kind)}" if operation == "bfi" else f"bfe_{c_type(kind)}"
    return write(operands[0], kind, f"{name}({', '.join(values)})", function)


def words(name: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return what is a function of 32-bit words, of this name: prmt, lop3, shf."""
    refuse_others(name, modifiers, {"b32"})
    values = ", ".join(read(o, "u32", function) for o in operands[1:])
    return write(operands[0], "u32", f"{name}({values})", function)


def dot(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return dp2a and dp4a: sums of products of a's halves or bytes with b's bytes."""
    *half, a_kind, b_kind = modifiers
    signs = f"{int(a_kind[0] == 's')}, {int(b_kind[0] == 's')}"
    if {a_kind, b_kind} - {"u32", "s32"} or set(half) - {"lo", "hi"}:
        raise UnknownPtxError(operation)
    values = ", ".join(read(o, "u32", function) for o in operands[1:])
    first = 2 if "hi" in half else 0
    return write(operands[0], "u32", f"dot({2 if operation == 'dp2a' else 4}, {first}, {signs}, {values})", function)

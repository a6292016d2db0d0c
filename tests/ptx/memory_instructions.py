"""PTX instructions that touch memory, as statements of C."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from ptx.operands import UnknownPtxError, address_of, c_type, name_of, read, width_of, write

if TYPE_CHECKING:
    from ptx.translate import Function


def _place(operand: str, space: str, kind: str, function: Function, *, bytes_at_once: int) -> str:
    """Return a pointer, as C, to what an operand in brackets points at."""
    found = re.fullmatch(r"\[\s*([%\w$.]+)\s*(?:\+\s*(-?\d+))?\s*\]", operand)
    if found is None:
        raise UnknownPtxError(f"address {operand}")
    base, offset = found.group(1), int(found.group(2) or 0)
    if base in function.registers:
        address = f"((u64){name_of(base)} + (u64)({offset}ll))" if offset else f"(u64){name_of(base)}"
    elif base.isdigit():
        address = f"{base}ull"
    else:
        address = f"({address_of(base, function)} + {offset})"
        if base in function.globals or base in function.pointers:
            return f"({c_type(kind)} *){address}"
    last = f"{bytes_at_once}, {function.line}"
    space = "local" if base in function.locals else space
    if space == "shared":
        return f"({c_type(kind)} *)at_shared(t, (u32){address}, {last})"
    if space in {"local", "param"}:
        return f"({c_type(kind)} *)at_{space}(t, {address}, {last})"
    return f"({c_type(kind)} *)at_{space}(t, {function.site()}, {address}, {last})"


def _space_and_vector(modifiers: list[str]) -> tuple[str, int]:
    space = next((m.split("::")[0] for m in modifiers if m.split("::")[0] in _SPACES), "generic")
    vector = next((int(m[1:]) for m in modifiers if m in {"v2", "v4"}), 1)
    allowed = {*_SPACES, "v2", "v4", "volatile", "nc", "relaxed", "acquire", "release", "weak", "gpu", "cta", "sys"}
    allowed |= {"ca", "cg", "cs", "cv", "lu", "wb", "wt"}
    for modifier in modifiers:
        if modifier.split("::")[0] not in allowed:
            raise UnknownPtxError(f"ld or st .{modifier}")
    return ("global" if space == "const" else space), vector


_SPACES = {"global", "shared", "local", "param", "const"}


def load(modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return ld: all is read before any register changes, as one may hold the address."""
    kind = modifiers[-1]
    space, count = _space_and_vector(modifiers[:-1])
    size = width_of(kind) // 8
    if operands[1].strip("[] ").split("+")[0].strip() in function.globals:
        space = "global"
    pointer = _place(operands[1], space, kind, function, bytes_at_once=size * count)
    registers = operands[0].strip("{} ").split(",")
    if len(registers) != count:
        raise UnknownPtxError(f"a load of {count} into {operands[0]}")
    reads = "".join(f" v{i} = at[{i}];" for i in range(count))
    values = ", ".join(f"v{i}" for i in range(count))
    writes = " ".join(write(r.strip(), kind, f"v{i}", function) for i, r in enumerate(registers))
    in_c = c_type(kind)
    return f"{{ const {in_c} *at = {pointer}; {in_c} {values};{reads} {writes} }}"


def store(modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return st."""
    kind = modifiers[-1]
    space, count = _space_and_vector(modifiers[:-1])
    pointer = _place(operands[0], space, kind, function, bytes_at_once=width_of(kind) // 8 * count)
    registers = operands[1].strip("{} ").split(",")
    if len(registers) != count:
        raise UnknownPtxError(f"a store of {count} from {operands[1]}")
    writes = " ".join(f"at[{i}] = {read(r.strip(), kind, function)};" for i, r in enumerate(registers))
    return f"{{ {c_type(kind)} *at = {pointer}; {writes} }}"


def atomic(modifiers: list[str], operands: list[str], function: Function, *, answers: bool) -> str:
    """Return atom, which ``answers`` with what was there, or red."""
    kind = modifiers[-1]
    operation = next((m for m in modifiers if m in _ATOMICS), None)
    space = next((m.split("::")[0] for m in modifiers if m.split("::")[0] in _SPACES), "generic")
    known = {*_SPACES, *_ATOMICS, "relaxed", "acquire", "release", "acq_rel", "gpu", "cta", "sys"}
    if operation is None or {m.split("::")[0] for m in modifiers[:-1]} - known:
        raise UnknownPtxError(f"atom.{'.'.join(modifiers)}")
    destination, *rest = operands if answers else ["_", *operands]
    pointer = _place(rest[0], space, kind, function, bytes_at_once=width_of(kind) // 8)
    values = [read(r, kind, function) for r in rest[1:]]
    in_c = c_type(kind)
    new = _ATOMICS[operation].format(*values, kind=in_c)
    return (
        f"{{ {in_c} *at = {pointer}; const {in_c} old = *at; *at = ({in_c})({new}); "
        f"{write(destination, kind, 'old', function)} }}"
    )


_ATOMICS = {
    "add": "old + {0}",
    "min": "min_{kind}(old, {0})",
    "max": "max_{kind}(old, {0})",
    "and": "old & {0}",
    "or": "old | {0}",
    "xor": "old ^ {0}",
    "exch": "{0}",
    "cas": "old == {0} ? {1} : old",
    "inc": "old >= {0} ? 0 : old + 1",
    "dec": "old == 0 || old > {0} ? {0} : old - 1",
}


def to_or_from_space(modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return cvta: only shared memory has addresses of its own here."""
    space = next((m.split("::")[0] for m in modifiers if m.split("::")[0] in _SPACES), None)
    if space is None:
        raise UnknownPtxError(f"cvta.{'.'.join(modifiers)}")
    value = read(operands[1], "u64", function)
    if space == "shared":
        value = f"{value} - (u64)t->shared" if "to" in modifiers else f"{value} + (u64)t->shared"
    return write(operands[0], "u64", value, function)

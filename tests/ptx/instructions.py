"""One PTX instruction, as a statement of C.

An instruction is an operation, dot-separated modifiers and types, and operands; see NVIDIA's "PTX ISA". What is not
known here is an error that names it: nothing is passed over.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ptx.translate import Function


class UnknownPtxError(NotImplementedError):
    """Something of PTX that is not translated."""


_INTEGER = re.compile(r"^[busBUS]?(?:[bus])(8|16|32|64)$")
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
_MODES = {"rz": "FE_TOWARDZERO", "rm": "FE_DOWNWARD", "rp": "FE_UPWARD"}
_COMPARISONS = {"eq": "==", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "lo": "<", "ls": "<=", "hi": ">", "hs": ">="}


def _split(text: str) -> list[str]:
    """Return operands: what commas separate, but for those within brackets and braces."""
    return [part.strip() for part in re.split(r",(?![^{\[]*[}\]])", text) if part.strip()]


def _is_float(kind: str) -> bool:
    return kind in {"f32", "f64"}


def _width(kind: str) -> int:
    return 1 if kind == "pred" else int(kind[1:])


def _c_type(kind: str) -> str:
    return kind.replace("b", "u") if kind != "pred" else "pred"


def name_of(register: str) -> str:
    """Return a register's name in C."""
    return "R" + register[1:]


def read(operand: str, kind: str, function: Function) -> str:
    """Return an operand's value as an expression of a type."""
    if operand in _SPECIAL:
        return f"(({_c_type(kind)}){_SPECIAL[operand]})"
    held = function.registers.get(operand)
    if held is not None:
        name = name_of(operand)
        if held == _c_type(kind):
            return name
        if _is_float(kind) != _is_float(held):
            to = kind if _is_float(kind) else f"u{_width(held)}"
            if _width(held) < _width(kind):
                raise UnknownPtxError(f"{operand} of type {held}, read as {kind}")
            inner = f"bits_{kind}((u{_width(kind)}){name})" if _is_float(kind) else f"{held}_bits({name})"
            return inner if _is_float(kind) else f"(({_c_type(kind)}){to and inner})"
        return f"(({_c_type(kind)}){name})"
    if re.fullmatch(r"0[fF][0-9a-fA-F]{8}", operand):
        value = f"bits_f32(0x{operand[2:]}u)"
        return value if kind == "f32" else f"0x{operand[2:]}u"
    if re.fullmatch(r"0[dD][0-9a-fA-F]{16}", operand):
        value = f"bits_f64(0x{operand[2:]}ull)"
        return value if kind == "f64" else f"0x{operand[2:]}ull"
    if re.fullmatch(r"-?(0[xX][0-9a-fA-F]+|\d+)U?", operand):
        number = int(operand.removesuffix("U"), 0)
        return f"(({_c_type(kind)})0x{number & (2**64 - 1):x}ull)"
    return f"(({_c_type(kind)}){address_of(operand, function)})"


def address_of(name: str, function: Function) -> str:
    """Return a variable's address in its own space."""
    name, _, offset = name.partition("+")
    more = f" + {int(offset)}" if offset else ""
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
    if held == _c_type(kind) or _is_float(held) == _is_float(kind):
        if kind[0] == "s" and _width(held) > _width(kind):
            return f"{name_of(register)} = ({held})(s{_width(held)})({value});"
        return f"{name_of(register)} = ({held})({value});"
    if _is_float(kind):
        return f"{name_of(register)} = {kind}_bits({value});"
    return f"{name_of(register)} = bits_{held}(({_c_type('u' + held[1:])})({value}));"


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
        if base in function.globals:
            return f"({_c_type(kind)} *){address}"
    last = f"{bytes_at_once}, {function.line}"
    if space == "shared":
        return f"({_c_type(kind)} *)at_shared(t, (u32){address}, {last})"
    if space in {"local", "param"}:
        return f"({_c_type(kind)} *)at_{space}(t, {address}, {last})"
    return f"({_c_type(kind)} *)at_{space}(t, {function.site()}, {address}, {last})"


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


def _load(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    space, count = _space_and_vector(modifiers[:-1])
    size = _width(kind) // 8
    if operands[1].strip("[] ").split("+")[0].strip() in function.globals:
        space = "global"
    pointer = _place(operands[1], space, kind, function, bytes_at_once=size * count)
    registers = operands[0].strip("{} ").split(",")
    if len(registers) != count:
        raise UnknownPtxError(f"a load of {count} into {operands[0]}")
    # All are read before any register changes: one may hold the address.
    reads = "".join(f" v{i} = at[{i}];" for i in range(count))
    values = ", ".join(f"v{i}" for i in range(count))
    writes = " ".join(write(r.strip(), kind, f"v{i}", function) for i, r in enumerate(registers))
    c_type = _c_type(kind)
    return f"{{ const {c_type} *at = {pointer}; {c_type} {values};{reads} {writes} }}"


def _store(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    space, count = _space_and_vector(modifiers[:-1])
    pointer = _place(operands[0], space, kind, function, bytes_at_once=_width(kind) // 8 * count)
    registers = operands[1].strip("{} ").split(",")
    if len(registers) != count:
        raise UnknownPtxError(f"a store of {count} from {operands[1]}")
    writes = " ".join(f"at[{i}] = {read(r.strip(), kind, function)};" for i, r in enumerate(registers))
    return f"{{ {_c_type(kind)} *at = {pointer}; {writes} }}"


def _atomic(modifiers: list[str], operands: list[str], function: Function, *, answers: bool) -> str:
    kind = modifiers[-1]
    operation = next((m for m in modifiers if m in _ATOMICS), None)
    space = next((m.split("::")[0] for m in modifiers if m.split("::")[0] in _SPACES), "generic")
    if operation is None:
        raise UnknownPtxError(f"atom.{'.'.join(modifiers)}")
    destination, *rest = operands if answers else ["_", *operands]
    pointer = _place(rest[0], space, kind, function, bytes_at_once=_width(kind) // 8)
    values = [read(r, kind, function) for r in rest[1:]]
    c_type = _c_type(kind)
    new = _ATOMICS[operation].format(*values, kind=c_type)
    return (
        f"{{ {c_type} *at = {pointer}; const {c_type} old = *at; *at = ({c_type})({new}); "
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


def _compare(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind, comparison, rest = modifiers[-1], modifiers[0], modifiers[1:-1]
    a, b = (read(o, kind, function) for o in operands[1:3])
    plain = comparison.removesuffix("u") if _is_float(kind) and len(comparison) == 3 else comparison
    if comparison == "num":
        value = f"({a} == {a} && {b} == {b})"
    elif comparison == "nan":
        value = f"({a} != {a} || {b} != {b})"
    elif plain == "ne":
        ordered = f"({a} == {a} && {b} == {b} && {a} != {b})"
        value = ordered if _is_float(kind) and plain == comparison else f"({a} != {b})"
    elif plain in _COMPARISONS:
        unordered = f" || {a} != {a} || {b} != {b}" if plain != comparison else ""
        value = f"({a} {_COMPARISONS[plain]} {b}{unordered})"
    else:
        raise UnknownPtxError(f"setp.{'.'.join(modifiers)}")
    joins = [m for m in rest if m in {"and", "or", "xor"}]
    if set(rest) - {"and", "or", "xor", "ftz"} or "|" in operands[0]:
        raise UnknownPtxError(f"setp.{'.'.join(modifiers)} {operands[0]}")
    if joins:
        last = operands[3]
        third = f"!{name_of(last[1:])}" if last.startswith("!") else read(last, "pred", function)
        value = f"({value} {({'and': '&', 'or': '|', 'xor': '^'})[joins[0]]} {third})"
    return write(operands[0], "pred", value, function)


def _convert(modifiers: list[str], operands: list[str], function: Function) -> str:
    *how, to, source = modifiers
    value = read(operands[1], source, function)
    mode = next((m for m in how if m in {"rn", "rz", "rm", "rp", "rni", "rzi", "rmi", "rpi"}), None)
    if set(how) - {mode, "sat", "ftz"} or "16" in (
        to + source if "f" in (to[0], source[0]) and "f16" in to + source else ""
    ):
        raise UnknownPtxError(f"cvt.{'.'.join(modifiers)}")
    if "ftz" in how and source == "f32":
        value = f"ftz_f32({value})"
    if _is_float(source) and _is_float(to):
        if mode in {"rni", "rzi", "rmi", "rpi"}:
            value = f"{mode}_{source}({value})"
        elif mode not in {None, "rn"}:
            raise UnknownPtxError(f"cvt.{'.'.join(modifiers)}")
        value = f"(({to}){value})"
        if "sat" in how:
            value = f"sat_{to}({value})"
    elif _is_float(source):
        value = f"{to}_of_{source}({mode}_{source}({value}))"
    elif _is_float(to):
        if mode != "rn":
            raise UnknownPtxError(f"cvt.{'.'.join(modifiers)}")
        value = f"(({to}){value})"
    elif "sat" in how:
        raise UnknownPtxError(f"cvt.{'.'.join(modifiers)}")
    else:
        value = f"(({_c_type(to)}){value})"
    return write(operands[0], to, value, function)


def _arithmetic(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return add, sub, mul, mad, fma, div and their like."""
    kind, how = modifiers[-1], modifiers[:-1]
    full = ".".join([operation, *modifiers])
    if _is_float(kind):
        if set(how) - {"rn", "rz", "rm", "rp", "ftz", "sat", "approx", "full"}:
            raise UnknownPtxError(full)
        values = [read(o, kind, function) for o in operands[1:]]
        values = [f"ftz_{kind}({v})" for v in values] if "ftz" in how else values
        mode = next((_MODES[m] for m in how if m in _MODES), None)
        if mode:
            number = {"add": 0, "mul": 1, "fma": 2, "div": 3, "sqrt": 4}.get(operation)
            if number is None:
                raise UnknownPtxError(full)
            value = f"directed_{kind}({mode}, {number}, {', '.join([*values, '0', '0'][:3])})"
        else:
            value = _FLOATS[operation].format(*values, kind=kind)
        value = f"ftz_{kind}({value})" if "ftz" in how else value
        value = f"sat_{kind}({value})" if "sat" in how else value
        return write(operands[0], kind, value, function)
    width = _width(kind)
    part = next((m for m in how if m in {"lo", "hi", "wide"}), "lo")
    if set(how) - {"lo", "hi", "wide"}:
        raise UnknownPtxError(full)
    unsigned = f"u{width}"
    a, b = (read(o, kind, function) for o in operands[1:3])
    if operation in {"div", "rem"}:
        return write(operands[0], kind, f"{operation}_{kind}({a}, {b})", function)
    if operation in {"add", "sub"}:
        sign = "+" if operation == "add" else "-"
        return write(operands[0], kind, f"({_c_type(kind)})(({unsigned}){a} {sign} ({unsigned}){b})", function)
    to = f"{kind[0]}{2 * width}" if part == "wide" else kind
    # As 64 bits: what C multiplies as int may not overflow.
    wide = "s64" if kind[0] == "s" else "u64"
    product = f"mulhi_{kind}({a}, {b})" if part == "hi" else f"(u64)({wide}){a} * (u64)({wide}){b}"
    if operation == "mad":
        product = f"{product} + (u64){read(operands[3], to, function)}"
    return write(operands[0], to, f"({_c_type(to)})({product})", function)


_FLOATS = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "fma": "fma_{kind}({0}, {1}, {2})",
    "mad": "fma_{kind}({0}, {1}, {2})",
    "rcp": "1 / {0}",
    "rsqrt": "({kind})(1 / sqrt((double){0}))",
    "sqrt": "sqrt_{kind}({0})",
    "ex2": "({kind})exp2((double){0})",
    "lg2": "({kind})log2((double){0})",
    "sin": "({kind})sin((double){0})",
    "cos": "({kind})cos((double){0})",
    "tanh": "({kind})tanh((double){0})",
}


def _minimum(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    if modifiers[:-1] and modifiers[:-1] != ["ftz"]:
        raise UnknownPtxError(f"{operation}.{'.'.join(modifiers)}")
    values = ", ".join(read(o, kind, function) for o in operands[1:])
    return write(operands[0], kind, f"{operation}_{kind}({values})", function)


def _unary(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return not, neg, abs, popc, clz, brev, cnot."""
    kind = modifiers[-1]
    a, width = read(operands[1], kind, function), _width(kind)
    if operation == "neg":
        value = f"-{a}" if _is_float(kind) else f"({_c_type(kind)})(0 - (u{width}){a})"
    elif operation == "abs":
        value = f"abs_{kind}({a})" if _is_float(kind) else f"({a} < 0 ? ({_c_type(kind)})(0 - (u{width}){a}) : {a})"
    elif operation == "not":
        value = f"!{a}" if kind == "pred" else f"~{a}"
    elif operation == "cnot":
        value = f"{a} == 0"
    elif operation == "popc":
        return write(operands[0], "u32", f"__builtin_popcountll({a})", function)
    elif operation == "clz":
        return write(operands[0], "u32", f"clz_{width}({a})", function)
    else:
        value = f"brev_{width}({a})"
    return write(operands[0], kind, value, function)


def _logic(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    sign = {"and": "&", "or": "|", "xor": "^"}[operation]
    a, b = (read(o, kind, function) for o in operands[1:3])
    return write(operands[0], kind, f"({a} {sign} {b})", function)


def _shift(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    name = f"shl_{_width(kind)}" if operation == "shl" else f"shr_{_c_type(kind)}"
    value = f"{name}({read(operands[1], kind, function)}, {read(operands[2], 'u32', function)})"
    return write(operands[0], kind, value, function)


def _select(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    a, b = (read(o, kind, function) for o in operands[1:3])
    return write(operands[0], kind, f"({read(operands[3], 'pred', function)} ? {a} : {b})", function)


def _move(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    target, source = operands
    if target.startswith("{"):
        registers = [r.strip() for r in target.strip("{} ").split(",")]
        part = _width(kind) // len(registers)
        whole = read(source, kind, function)
        pieces = [write(r, f"u{part}", f"(u{part})(whole >> {i * part})", function) for i, r in enumerate(registers)]
        return f"{{ const u{_width(kind)} whole = {whole}; {' '.join(pieces)} }}"
    if source.startswith("{"):
        registers = [r.strip() for r in source.strip("{} ").split(",")]
        part, width = _width(kind) // len(registers), _width(kind)
        pieces = [f"((u{width}){read(r, f'u{part}', function)} << {i * part})" for i, r in enumerate(registers)]
        return write(target, kind, " | ".join(pieces), function)
    return write(target, kind, read(source, kind, function), function)


def _to_or_from_space(modifiers: list[str], operands: list[str], function: Function) -> str:
    space = next(m.split("::")[0] for m in modifiers if m.split("::")[0] in _SPACES)
    value = read(operands[1], "u64", function)
    if space == "shared":
        value = f"{value} - (u64)t->shared" if "to" in modifiers else f"{value} + (u64)t->shared"
    return write(operands[0], "u64", value, function)


def _find_bit(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    value = f"bfind_{_c_type(kind)}({read(operands[1], kind, function)})"
    if "shiftamt" in modifiers:
        value = f"shifted({value}, {_width(kind)})"
    return write(operands[0], "u32", value, function)


def _field(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    count = 2 if operation == "bfi" else 1
    values = [read(o, kind, function) for o in operands[1 : 1 + count]]
    values += [read(o, "u32", function) for o in operands[1 + count :]]
    name = f"bfi_{_width(kind)}" if operation == "bfi" else f"bfe_{_c_type(kind)}"
    return write(operands[0], kind, f"{name}({', '.join(values)})", function)


def _words(name: str, operands: list[str], function: Function) -> str:
    values = ", ".join(read(o, "u32", function) for o in operands[1:])
    return write(operands[0], "u32", f"{name}({values})", function)


def _dot(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return dp2a and dp4a: sums of products of a's halves or bytes with b's bytes."""
    *half, a_kind, b_kind = modifiers
    signs = f"{int(a_kind[0] == 's')}, {int(b_kind[0] == 's')}"
    if {a_kind, b_kind} - {"u32", "s32"} or set(half) - {"lo", "hi"}:
        raise UnknownPtxError(operation)
    values = ", ".join(read(o, "u32", function) for o in operands[1:])
    first = 2 if "hi" in half else 0
    return write(operands[0], "u32", f"dot({2 if operation == 'dp2a' else 4}, {first}, {signs}, {values})", function)


def _together(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return what makes threads wait for each other."""
    function.together = True
    if operation in {"bar", "barrier"} and "sync" in modifiers and operands == ["0"]:
        return f"barrier(t, {function.line});"
    if operation == "vote" and modifiers[:2] == ["sync", "ballot"]:
        voter = operands[1]
        value = f"!{name_of(voter[1:])}" if voter.startswith("!") else read(voter, "pred", function)
        mask = read(operands[2], "u32", function)
        return write(operands[0], "u32", f"ballot(t, {value}, {mask}, {function.line})", function)
    raise UnknownPtxError(f"{operation}.{'.'.join(modifiers)} {', '.join(operands)}")


def _jump(operands: list[str]) -> str:
    return f"goto {operands[0].replace('$', 'L_')};"


_Handler = Callable[[str, list[str], list[str], "Function"], str]
_HANDLERS: dict[str, _Handler] = {
    **dict.fromkeys(
        ("add", "sub", "mul", "mad", "fma", "div", "rem", "rcp", "rsqrt", "sqrt", "ex2", "lg2", "sin", "cos", "tanh"),
        _arithmetic,
    ),
    **dict.fromkeys(("min", "max", "copysign"), _minimum),
    **dict.fromkeys(("not", "neg", "abs", "popc", "clz", "brev", "cnot"), _unary),
    **dict.fromkeys(("and", "or", "xor"), _logic),
    **dict.fromkeys(("shl", "shr"), _shift),
    **dict.fromkeys(("bfi", "bfe"), _field),
    **dict.fromkeys(("bar", "barrier", "vote", "shfl", "activemask", "match", "redux"), _together),
    **dict.fromkeys(("dp2a", "dp4a"), _dot),
    "bfind": lambda _, m, o, f: _find_bit(m, o, f),
    "ld": lambda _, m, o, f: _load(m, o, f),
    "st": lambda _, m, o, f: _store(m, o, f),
    "atom": lambda _, m, o, f: _atomic(m, o, f, answers=True),
    "red": lambda _, m, o, f: _atomic(m, o, f, answers=False),
    "setp": lambda _, m, o, f: _compare(m, o, f),
    "selp": lambda _, m, o, f: _select(m, o, f),
    "cvt": lambda _, m, o, f: _convert(m, o, f),
    "cvta": lambda _, m, o, f: _to_or_from_space(m, o, f),
    "mov": lambda _, m, o, f: _move(m, o, f),
    "prmt": lambda _, _m, o, f: _words("prmt", o, f),
    "lop3": lambda _, _m, o, f: _words("lop3", o, f),
    "shf": lambda _, m, o, f: _words(f"shf_{m[0]}_{m[1]}", o, f),
    "bra": lambda _, _m, o, _f: _jump(o),
    "ret": lambda *_: "return;",
    "exit": lambda *_: "return;",
    "trap": lambda _, _m, _o, f: f'fault(t, "trap", 0, 0, {f.line});',
    "membar": lambda *_: ";",
    "fence": lambda *_: ";",
}


def statement(text: str, function: Function) -> str:
    """Return an instruction as C; raises UnknownPtxError, with its text, where it is not known."""
    guard = ""
    found = re.match(r"@(!?)(%\w+)\s+(.*)", text)
    if found:
        guard = f"if ({found.group(1)}{name_of(found.group(2))}) "
        text = found.group(3)
    name, _, rest = text.partition(" ")
    operation, *modifiers = name.split(".")
    handler = _HANDLERS.get(operation)
    try:
        if handler is None:
            raise UnknownPtxError(operation)
        return guard + handler(operation, modifiers, _split(rest.replace("\t", " ")), function)
    except (UnknownPtxError, KeyError, IndexError, ValueError) as error:
        raise UnknownPtxError(f"PTX line {function.line}: {text}: {error}") from error

"""One PTX instruction, as a statement of C.

An instruction is an operation, dot-separated modifiers and types, and operands; see NVIDIA's "PTX ISA". What is not
known here is an error that names it: nothing is passed over.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from ptx.bit_instructions import dot, field, find_bit, logic, shift, words
from ptx.memory_instructions import atomic, load, store, to_or_from_space
from ptx.operands import UnknownPtxError, c_type, is_float, name_of, read, refuse_others, split, width_of, write

if TYPE_CHECKING:
    from ptx.translate import Function

_MODES = {"rz": "FE_TOWARDZERO", "rm": "FE_DOWNWARD", "rp": "FE_UPWARD"}
_COMPARISONS = {"eq": "==", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "lo": "<", "ls": "<=", "hi": ">", "hs": ">="}


def _flushed(value: str, kind: str, modifiers: list[str]) -> str:
    """Return a value whose subnormal numbers are 0 where an instruction says so."""
    return f"ftz_{kind}({value})" if "ftz" in modifiers else value


def _compare(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind, comparison, rest = modifiers[-1], modifiers[0], modifiers[1:-1]
    a, b = (_flushed(read(o, kind, function), kind, rest) for o in operands[1:3])
    plain = comparison.removesuffix("u") if is_float(kind) and len(comparison) == 3 else comparison
    if comparison == "num":
        value = f"({a} == {a} && {b} == {b})"
    elif comparison == "nan":
        value = f"({a} != {a} || {b} != {b})"
    elif plain == "ne":
        ordered = f"({a} == {a} && {b} == {b} && {a} != {b})"
        value = ordered if is_float(kind) and plain == comparison else f"({a} != {b})"
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
    if source == "f32":
        value = _flushed(value, "f32", how)
    if is_float(source) and is_float(to):
        if mode in {"rni", "rzi", "rmi", "rpi"}:
            value = f"{mode}_{source}({value})"
        elif mode not in {None, "rn"}:
            raise UnknownPtxError(f"cvt.{'.'.join(modifiers)}")
        value = f"(({to}){value})"
        if to == "f32":
            value = _flushed(value, "f32", how)
        if "sat" in how:
            value = f"sat_{to}({value})"
    elif is_float(source):
        value = f"{to}_of_{source}({mode}_{source}({value}))"
    elif is_float(to):
        if mode != "rn":
            raise UnknownPtxError(f"cvt.{'.'.join(modifiers)}")
        value = f"(({to}){value})"
    elif "sat" in how:
        raise UnknownPtxError(f"cvt.{'.'.join(modifiers)}")
    else:
        value = f"(({c_type(to)}){value})"
    return write(operands[0], to, value, function)


def _arithmetic(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return add, sub, mul, mad, fma, div and their like."""
    kind, how = modifiers[-1], modifiers[:-1]
    full = ".".join([operation, *modifiers])
    if is_float(kind):
        if set(how) - {"rn", "rz", "rm", "rp", "ftz", "sat", "approx", "full"}:
            raise UnknownPtxError(full)
        values = [read(o, kind, function) for o in operands[1:]]
        values = [_flushed(v, kind, how) for v in values]
        mode = next((_MODES[m] for m in how if m in _MODES), None)
        if mode:
            number = {"add": 0, "mul": 1, "fma": 2, "div": 3, "sqrt": 4}.get(operation)
            if number is None:
                raise UnknownPtxError(full)
            value = f"directed_{kind}({mode}, {number}, {', '.join([*values, '0', '0'][:3])})"
        else:
            value = _FLOATS[operation].format(*values, kind=kind)
        value = _flushed(value, kind, how)
        value = f"sat_{kind}({value})" if "sat" in how else value
        return write(operands[0], kind, value, function)
    width = width_of(kind)
    part = next((m for m in how if m in {"lo", "hi", "wide"}), "lo")
    if set(how) - {"lo", "hi", "wide"}:
        raise UnknownPtxError(full)
    unsigned = f"u{width}"
    a, b = (read(o, kind, function) for o in operands[1:3])
    if operation in {"div", "rem"}:
        return write(operands[0], kind, f"{operation}_{kind}({a}, {b})", function)
    if operation in {"add", "sub"}:
        sign = "+" if operation == "add" else "-"
        return write(operands[0], kind, f"({c_type(kind)})(({unsigned}){a} {sign} ({unsigned}){b})", function)
    to = f"{kind[0]}{2 * width}" if part == "wide" else kind
    # As 64 bits: what C multiplies as int may not overflow.
    wide = "s64" if kind[0] == "s" else "u64"
    product = f"mulhi_{kind}({a}, {b})" if part == "hi" else f"(u64)({wide}){a} * (u64)({wide}){b}"
    if operation == "mad":
        product = f"{product} + (u64){read(operands[3], to, function)}"
    return write(operands[0], to, f"({c_type(to)})({product})", function)


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
    refuse_others(operation, modifiers[:-1], {"ftz"})
    values = ", ".join(_flushed(read(o, kind, function), kind, modifiers) for o in operands[1:])
    return write(operands[0], kind, f"{operation}_{kind}({values})", function)


def _unary(operation: str, modifiers: list[str], operands: list[str], function: Function) -> str:
    """Return not, neg, abs, popc, clz, brev, cnot."""
    kind = modifiers[-1]
    refuse_others(operation, modifiers[:-1], {"ftz"} if is_float(kind) else None)
    a, width = _flushed(read(operands[1], kind, function), kind, modifiers), width_of(kind)
    if operation == "neg":
        value = f"-{a}" if is_float(kind) else f"({c_type(kind)})(0 - (u{width}){a})"
    elif operation == "abs":
        value = f"abs_{kind}({a})" if is_float(kind) else f"({a} < 0 ? ({c_type(kind)})(0 - (u{width}){a}) : {a})"
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


def _select(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    refuse_others("selp", modifiers[:-1])
    a, b = (read(o, kind, function) for o in operands[1:3])
    return write(operands[0], kind, f"({read(operands[3], 'pred', function)} ? {a} : {b})", function)


def _move(modifiers: list[str], operands: list[str], function: Function) -> str:
    kind = modifiers[-1]
    refuse_others("mov", modifiers[:-1])
    target, source = operands
    if target.startswith("{"):
        registers = [r.strip() for r in target.strip("{} ").split(",")]
        part = width_of(kind) // len(registers)
        whole = read(source, kind, function)
        pieces = [write(r, f"u{part}", f"(u{part})(whole >> {i * part})", function) for i, r in enumerate(registers)]
        return f"{{ const u{width_of(kind)} whole = {whole}; {' '.join(pieces)} }}"
    if source.startswith("{"):
        registers = [r.strip() for r in source.strip("{} ").split(",")]
        part, width = width_of(kind) // len(registers), width_of(kind)
        pieces = [f"((u{width}){read(r, f'u{part}', function)} << {i * part})" for i, r in enumerate(registers)]
        return write(target, kind, " | ".join(pieces), function)
    return write(target, kind, read(source, kind, function), function)


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


def _call(operands: list[str], function: Function) -> str:
    """Return the call of a function of the module, with the addresses of what it is given and of its answer."""
    found = re.fullmatch(r"(?:\(\s*(\w+)\s*\), )?([\w$]+)(?:, \((.*)\))?", ", ".join(operands))
    if found is None:
        raise UnknownPtxError(f"call {', '.join(operands)}")
    answer, name, given = found.groups()
    addresses = [read(o.strip(), "u64", function) for o in (given or "").split(",") if o.strip()]
    place = read(answer, "u64", function) if answer else "0"
    return (
        f"{{ const u64 own = t->local, end = t->local_end, given[] = {{{', '.join([*addresses, '0'])}}}; "
        f"func_{name}(t, {place}, given); t->local = own; t->local_end = end; }}"
    )


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
    **dict.fromkeys(("and", "or", "xor"), logic),
    **dict.fromkeys(("shl", "shr"), shift),
    **dict.fromkeys(("bfi", "bfe"), field),
    **dict.fromkeys(("bar", "barrier", "vote", "shfl", "activemask", "match", "redux"), _together),
    **dict.fromkeys(("dp2a", "dp4a"), dot),
    "bfind": lambda _, m, o, f: find_bit(m, o, f),
    "ld": lambda _, m, o, f: load(m, o, f),
    "st": lambda _, m, o, f: store(m, o, f),
    "atom": lambda _, m, o, f: atomic(m, o, f, answers=True),
    "red": lambda _, m, o, f: atomic(m, o, f, answers=False),
    "setp": lambda _, m, o, f: _compare(m, o, f),
    "selp": lambda _, m, o, f: _select(m, o, f),
    "cvt": lambda _, m, o, f: _convert(m, o, f),
    "cvta": lambda _, m, o, f: to_or_from_space(m, o, f),
    "mov": lambda _, m, o, f: _move(m, o, f),
    "prmt": lambda _, m, o, f: words("prmt", m, o, f),
    "lop3": lambda _, m, o, f: words("lop3", m, o, f),
    "shf": lambda _, m, o, f: words(f"shf_{m[0]}_{m[1]}", m[2:], o, f),
    "call": lambda _, _m, o, f: _call(o, f),
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
        return guard + handler(operation, modifiers, split(rest.replace("\t", " ")), function)
    except (UnknownPtxError, KeyError, IndexError, ValueError) as error:
        raise UnknownPtxError(f"PTX line {function.line}: {text}: {error}") from error

"""From the text of a PTX module to the text of a C file with the same kernels."""

import re
from dataclasses import dataclass, field

from ptx.instructions import statement
from ptx.operands import UnknownPtxError, name_of

_REGISTERS = re.compile(r"\.reg\s+\.(\w+)\s+(%\w+)(?:<(\d+)>)?$")
_VARIABLE = re.compile(
    r"(?:\.(?:visible|extern|weak|common)\s+)*\.(global|const|shared|local|param)\s+"
    r"(?:\.align\s+(\d+)\s+)?\.(\w+)\s+([\w$]+)(?:\[(\d*)\])?\s*(?:=\s*(.*))?$",
    re.DOTALL,
)
_ENTRY = re.compile(r"(?:\.(?:visible|weak)\s+)*\.entry\s+([\w$]+)\s*\((.*)\)", re.DOTALL)
_SIZES = {"8": 1, "16": 2, "32": 4, "64": 8}
_C_TYPES = {"pred": "pred", "f32": "f32", "f64": "f64", "b8": "u8", "b16": "u16", "b32": "u32", "b64": "u64"}


def size_of(kind: str) -> int:
    """Return the bytes of a type's name, such as ``u32``."""
    return _SIZES[kind[1:]]


@dataclass(frozen=True)
class Variable:
    """A module's, a function's or a parameter's piece of memory."""

    space: str
    align: int
    kind: str
    name: str
    bytes: int
    values: str | None


@dataclass
class Function:
    """What the translation of a kernel's instructions has to know, and what it finds."""

    name: str
    registers: dict[str, str] = field(default_factory=dict)
    params: dict[str, int] = field(default_factory=dict)
    shared: dict[str, int] = field(default_factory=dict)
    locals: dict[str, int] = field(default_factory=dict)
    globals: dict[str, Variable] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    together: bool = False
    sites: int = 0
    line: int = 0

    def site(self) -> str:
        """Return what an instruction remembers of where its last address lay."""
        self.sites += 1
        return f"&sites[{self.sites - 1}]"


def _variable(text: str) -> Variable | None:
    found = _VARIABLE.match(text)
    if found is None:
        return None
    space, align, kind, name, count, values = found.groups()
    size = size_of(kind)
    total = size * (int(count or 0) if count is not None else 1)
    return Variable(space, int(align or size), kind, name, total, values)


def _c_value(text: str) -> str:
    text = text.strip()
    if text.startswith(("0f", "0d")):
        return "0x" + text[2:] + "ull"
    return text.removesuffix("U") + ("ull" if not text.startswith("-") else "ll")


def _initialised(variable: Variable) -> str:
    """Return the definition in C of a global or constant variable."""
    kind, size = "u" + variable.kind[1:], size_of(variable.kind)
    values = (variable.values or "").strip().strip("{}")
    if re.search(r"[A-Za-z_$]{3,}", values.replace("0x", "")) and not values.startswith(("0f", "0d")):
        raise UnknownPtxError(f"variable {variable.name}: initialised with an address")
    listed = ", ".join(_c_value(v) for v in values.split(",") if v.strip()) or "0"
    storage = "static" if variable.space == "global" else "static const"
    count = max(variable.bytes // size, 1)
    return f"{storage} _Alignas({max(variable.align, 8)}) {kind} {variable.name}[{count}] = {{{listed}}};"


def _statements(text: str) -> list[tuple[int, str]]:
    """Return (line, statement) for each statement, label or brace of a function's body."""
    found, held, begun = [], "", 0
    for number, commented in enumerate(text.split("\n")):
        line = commented.split("//")[0].strip()
        # Braces around a statement of inline assembly, in which no register is declared.
        if not line or line.split()[0] in {".loc", ".pragma", ".file"} or (line == "{" and not held):
            continue
        label = re.match(r"^([\w$]+):$", line)
        if label and not held:
            found.append((number, line))
            continue
        for piece in re.split(r"(;)", line):
            if piece == ";":
                found.append((begun, " ".join(held.split()).lstrip("{ ")))
                held = ""
            elif piece.strip() and not (piece.strip() == "}" and not held):
                begun = begun if held else number
                held += " " + piece.strip()
    if held.strip():
        raise UnknownPtxError(f"a statement without an end: {held.strip()[:80]}")
    return found


def _entry(header: str, body: str, first_line: int, variables: dict[str, Variable]) -> tuple[str, set[str]]:
    """Return a kernel in C, and the module's variables that it names."""
    found = _ENTRY.match(header)
    if found is None:
        raise UnknownPtxError(f"a function that is no kernel: {header[:120]}")
    function = Function(found.group(1), globals=variables)
    copies, offset = [], 0
    for number, text in enumerate(p for p in found.group(2).split(",") if p.strip()):
        parameter = _variable(text.strip())
        if parameter is None:
            raise UnknownPtxError(f"parameter {text.strip()}")
        offset = -(-offset // max(parameter.align, 8)) * max(parameter.align, 8)
        function.params[parameter.name] = offset
        copies.append(f"    memcpy((unsigned char *)params + {offset}, args[{number}], {parameter.bytes});")
        offset += parameter.bytes
    params_size, local_size, shared_size = offset, 0, 0
    for variable in variables.values():
        if variable.space == "shared":
            shared_size = -(-shared_size // variable.align) * variable.align
            function.shared[variable.name] = shared_size
            shared_size += variable.bytes
    lines: list[str] = []
    for number, text in _statements(body):
        function.line = first_line + number
        registers, variable = _REGISTERS.match(text), _variable(text)
        if text.endswith(":"):
            lines.append(f"{text[:-1].replace('$', 'L_')}:;")
        elif registers:
            kind, name, count = registers.groups()
            names = [f"{name}{i}" for i in range(int(count))] if count else [name]
            for register in names:
                function.registers[register] = _C_TYPES[kind]
        elif variable:
            if variable.space == "local":
                local_size = -(-local_size // variable.align) * variable.align
                function.locals[variable.name] = local_size
                local_size += variable.bytes
            else:
                shared_size = -(-shared_size // variable.align) * variable.align
                function.shared[variable.name] = shared_size
                shared_size += variable.bytes
        else:
            lines.append("    " + statement(text, function))
    mentioned = " ".join(lines)
    names = set(re.findall(r"\bR\w+", mentioned))
    declared = [f"    {kind} {name_of(r)};" for r, kind in function.registers.items() if name_of(r) in names]
    name, local = function.name, max(local_size, 1)
    c = [
        f"static Site sites_{name}[{max(function.sites, 1)}];",
        f"static void body_{name}(Thread *t) {{",
        f"    Site *const sites = sites_{name};",
        f"    _Alignas(16) unsigned char depot[{local}];",
        f"    t->local = (u64)depot; t->local_end = (u64)depot + {local_size};",
        "    const u64 param = t->param; (void)param; (void)sites;",
        *declared,
        *lines,
        "}",
        f"const u32 size_{name} = {params_size};",
        f"void pack_{name}(void **args, void *params) {{",
        *copies,
        "}",
        f"int run_{name}(Launch *launch, void *params) {{",
        f"    return run_grid(launch, body_{name}, {int(function.together)}, (u64)params, (u64)params + {params_size},",
        f"                    {shared_size});",
        "}",
    ]
    return "\n".join(c), function.used


def to_c(ptx: str) -> str:
    """Return C with functions for each kernel of a PTX module.

    ``pack_kernel(void **args, void *params)`` copies arguments, of ``size_kernel`` bytes, as a launch does;
    ``run_kernel(Launch *, void *params)`` runs it.

    Raises UnknownPtxError, which names it, for what is not among the instructions that this knows.
    """
    ptx = ptx.rstrip("\0")
    variables: dict[str, Variable] = {}
    parts: list[str] = []
    used: set[str] = set()
    position = 0
    while match := re.compile(r"(\.visible|\.weak|\.entry|\.func|\.global|\.const|\.shared|\.extern)\b").search(
        ptx, position
    ):
        start = match.start()
        end, brace = ptx.index(";", start), re.compile(r"^\{", re.MULTILINE).search(ptx, start)
        if brace is None or end < brace.start():
            variable = _variable(ptx[start:end])
            if variable is None:
                raise UnknownPtxError(ptx[start:end][:120])
            variables[variable.name] = variable
            position = end + 1
            continue
        close = re.compile(r"^\}", re.MULTILINE).search(ptx, brace.end())
        assert close is not None, "a kernel's body ends"
        first_line = ptx.count("\n", 0, brace.end()) + 1
        c, names = _entry(ptx[start : brace.start()].strip(), ptx[brace.end() : close.start()], first_line, variables)
        parts.append(c)
        used |= names
        position = close.end()
    held = [_initialised(variable) for name, variable in variables.items() if name in used]
    return "\n".join(['#include "machine.h"', *held, *parts, ""])

"""PTX, which NVRTC makes of a kernel, as C++ for the fibers: a function of a thread is a function, a register a
variable, an instruction a line. So what runs on a GPU runs on the CPU, after NVRTC's optimiser, with the bits that its
instructions are defined to have.

python ptx.py KERNEL.ptx KERNEL.cpp
"""

import re
import sys
from pathlib import Path

from ptx_instructions import TYPES, Instructions, Unknown, bits_of_literal, in_cpp, label, register_name, split

RESULT = "func_retval0"
# What stands before a brace that opens a list of registers or an initialiser.
OPENS_LIST = re.compile(r"\s*(?:@!?%\w+\s+)?(?:mov|ld|st)\.|[^;]*=\s*$")
ARRAY = re.compile(r"\.align (\d+) \.b8 ([\w$]+)\[(\d*)\](?: = \{(.*)\})?")
SCALAR = re.compile(r"\.([busf]\d+) ([\w$]+)(?:\[(\d*)\])?(?: = (.*))?")
HEADER = re.compile(r"\.(entry|func)\s*(?:\((.*?)\)\s*)?([\w$]+)\s*(?:\((.*?)\))?\s*((?:\.\w+[^{]*)?\{?)$")


def statements(text):
    """(line, text) of each statement, which ends by a semicolon, a brace or the colon of a label. Braces of
    initialisers and of lists of registers stay within it."""
    text = re.sub(r"//[^\n]*", "", text)
    found, pending, depth, line, first = [], "", 0, 1, 1
    for letter in text:
        line += letter == "\n"
        if not pending.strip():
            first = line
        if letter == "{" and (depth or OPENS_LIST.match(pending)):
            depth += 1
        elif letter == "}" and depth:
            depth -= 1
        elif letter in ";{}":
            statement = " ".join(pending.split())
            if statement:
                found.append((first, statement + (" {" if letter == "{" else "")))
            if letter == "}" or (letter == "{" and not statement):
                found.append((first, letter))
            pending = ""
            continue
        elif letter == ":" and re.fullmatch(r"\s*\$?\w+", pending):
            found.append((first, pending.strip() + ":"))
            pending = ""
            continue
        pending += letter
    return found


def variable(text, storage=""):
    """The name of a variable of memory, and its declaration."""
    array, scalar = ARRAY.search(text), SCALAR.search(text)
    if array:
        align, name, size, values = array.groups()
    elif scalar:
        kind, name, count, value = scalar.groups()
        align = int(kind[1:]) // 8
        size, values = align * int(count or 1), None
        if value is not None:
            numbers = [bits_of_literal(n) % 2 ** (8 * align) for n in split(value.strip("{} "))]
            values = ", ".join(str(byte) for n in numbers for byte in n.to_bytes(align, "little"))
    else:
        raise Unknown(text)
    start = f" = {{{values}}}" if values else ""
    return name, f"alignas({align}) {storage}unsigned char {in_cpp(name)}[{size or 1}]{start};"


def place_of(name):
    return f"reinterpret_cast<uint64_t>({in_cpp(name)})"


class Function:
    """A function while it is read: take() gets its statements, text() is its C++."""

    def __init__(self, module, name, result, parameters):
        self.module, self.name, self.depth = module, name, 1
        self.kinds, self.registers, self.memory, self.code = {}, {}, [], []
        self.table = None  # the label before a table of jumps
        names = [variable(p)[0] for p in split(parameters or "")]
        self.places = {**module.places, **{n: place_of(n) for n in [*names, RESULT]}}
        arguments = "".join(f", [[maybe_unused]] const unsigned char* {in_cpp(n)}" for n in names)
        self.head = (
            f"[[gnu::noinline]] void {in_cpp(name)}([[maybe_unused]] unsigned char* {in_cpp(RESULT)}{arguments})"
        )
        self.instructions = Instructions(self.kinds, self.places, module.targets)

    def text(self):
        lines = [self.head + " {", "[[maybe_unused]] uint32_t carry = 0;", *self.registers, *self.memory, *self.code]
        return "\n".join([*lines, "}"])

    def take(self, statement):
        """Translates a statement of the body; returns whether the function goes on."""
        if statement in ("{", "}"):
            self.depth += 1 if statement == "{" else -1
            if self.depth == 0:
                return False
            self.code.append(statement)
        elif statement.startswith(".reg"):
            self._declare_registers(*re.fullmatch(r"\.reg \.(\w+) (.*)", statement).groups())
        elif statement.startswith((".local", ".param")):
            name, declaration = variable(statement.partition(" ")[2])
            self.places[name] = place_of(name)
            (self.memory if statement.startswith(".local") else self.code).append(declaration)
        elif statement.startswith((".shared", ".global", ".const")):
            self.module.declare(statement)
            self.places.update(self.module.places)
        elif ".branchtargets" in statement:
            self.module.targets[self.table] = split(statement.partition(".branchtargets")[2])
        elif statement.endswith(":"):
            self.table = statement[:-1]
            self.code.append(label(self.table) + ":;")
        elif not statement.startswith((".pragma", ".loc")):
            self.code.append(self.instructions.line(statement))
        return True

    def _declare_registers(self, kind, names):
        bits = TYPES[kind] if kind == "pred" else TYPES["u" + kind[1:]]
        for name in split(names):
            many = re.fullmatch(r"(%\w+)<(\d+)>", name)
            self.kinds[many[1] if many else name] = kind if kind == "pred" else "b" + kind[1:]
            each = [f"{many[1]}{k}" for k in range(int(many[2]))] if many else [name]
            for register in each:
                self.registers[f"[[maybe_unused]] {bits} {register_name(register)}{{}};"] = None


class Module:
    def __init__(self, text):
        self.places, self.targets, self.declarations, self.functions = {}, {}, {}, []
        self.entry, function = None, None
        for line, statement in statements(text):
            try:
                if function is None:
                    function = self._begin(statement)
                elif not function.take(statement):
                    self.functions.append(function.text())
                    function = None
            except (Unknown, KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
                raise SystemExit(f"line {line}: {statement[:200]}: {type(error).__name__} {error}") from error

    def declare(self, statement):
        """A variable of the module."""
        space, _, rest = statement[1:].partition(" ")
        if space == "extern":
            self.places[ARRAY.search(statement)[2]] = "reinterpret_cast<uint64_t>(fibers::block->memory.data())"
            return
        storage = {"shared": "static thread_local ", "const": "const ", "global": ""}[space]
        name, declaration = variable(rest, storage)
        self.places[name] = place_of(name)
        self.declarations[declaration] = None

    def _begin(self, statement):
        """The function that begins here, if one does."""
        statement = re.sub(r"^(\.version \S+ |\.target \S+ |\.address_size \d+ |\.visible |\.weak )+", "", statement)
        if statement.startswith((".extern", ".shared", ".global", ".const")):
            return self.declare(statement)
        header = HEADER.match(statement)
        if header is None:
            raise Unknown(statement)
        what, result, name, parameters, rest = header.groups()
        function = Function(self, name, result, parameters)
        self.declarations[function.head + ";"] = None
        if not rest.endswith("{"):
            return None
        if what == "entry":
            self.entry = name
        return function

    def text(self):
        parts = ['#include "fibers.h"', '#include "ptx.h"', "namespace {", *self.declarations, *self.functions, "}"]
        call = f"{in_cpp(self.entry)}(nullptr, static_cast<const unsigned char*>(arguments))"
        return "\n".join([*parts, f"PRDP_FIBERS_RUN({call})", ""])


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(Module(Path(sys.argv[1]).read_text()).text())

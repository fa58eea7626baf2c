"""A stand-in for a device, where there is none. Its tensors say that they are not on the CPU, though their numbers are.
Every operation on them is counted, and so is every copy of numbers to the host, on which a GPU would make it wait, and
from the host, which no CUDA graph could repeat."""

import collections

import torch
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("lazy", 0)  # of a kind that autograd takes without its driver
KEY = torch._C.DispatchKeySet(torch._C.DispatchKey.Lazy)
COPIES = {"_to_copy", "to", "copy_"}  # they may mix devices
READS = {"_local_scalar_dense", "item", "equal", "nonzero", "is_nonzero", "masked_select", "_unique2"}
# What takes a single number of the host beside tensors of CUDA: operations of two tensors, and those that read it here.
PAIRS = {
    "add", "sub", "rsub", "mul", "div", "pow", "remainder", "fmod", "atan2", "copysign", "nextafter", "maximum",
    "minimum", "eq", "ne", "lt", "le", "gt", "ge", "logical_and", "logical_or", "logical_xor", "bitwise_and",
    "bitwise_or", "bitwise_xor", "masked_fill", "fill",
}  # fmt: skip
SENDS = {"where"}  # it as well, by a copy
VIEWS_AND_MEMORY = {
    "alias", "as_strided", "detach", "empty", "empty_like", "empty_strided", "expand", "narrow", "new_empty", "permute",
    "select", "slice", "squeeze", "t", "transpose", "unbind", "unsqueeze", "view", "zeros_like", "_reshape_alias",
    "_unsafe_view",
}  # fmt: skip


def each(change, value):
    """`value` with the change made to each part of its lists and tuples."""
    return type(value)(each(change, part) for part in value) if isinstance(value, list | tuple) else change(value)


def tensors_in(args):
    return [a for a in args if isinstance(a, torch.Tensor)]


class _There(torch.Tensor):
    """A tensor on the stand-in."""

    @staticmethod
    def __new__(cls, numbers, device=DEVICE):
        made = torch.Tensor._make_wrapper_subclass(
            cls, numbers.shape, strides=numbers.stride(), storage_offset=numbers.storage_offset(), dtype=numbers.dtype,
            device=device,
        )  # fmt: skip
        made.numbers = numbers
        return made

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        raise AssertionError(f"{function} outside of `with StandIn()`")


class StandIn(TorchDispatchMode):
    """While it is entered, there is the device."""

    def __init__(self):
        super().__init__()
        self.operations = collections.Counter()
        self.copies_to_host = self.copies_from_host = 0
        self.largest = 0  # numbers in the memory of a result

    @staticmethod
    def send(tensor, device=DEVICE):
        return _There(tensor.detach().clone(), device)

    @staticmethod
    def fetch(tensor):
        return tensor.numbers if isinstance(tensor, _There) else tensor

    def launched(self):
        """How many operations there were, but for views and new memory."""
        return sum(count for name, count in self.operations.items() if name not in VIEWS_AND_MEMORY)

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function.namespace == "prdp":  # as on a device: its kernel works with operations of torch
            with self:
                return function.redispatch(KEY, *args, **kwargs)
        name = function._schema.name.removeprefix("aten::")
        given, devices, asked_for = [], [], []

        def numbers(value):
            if isinstance(value, _There):
                given.append(value)
                devices.append(value.device)
                return value.numbers
            if isinstance(value, torch.device):
                asked_for.append(value)
                return torch.device("cpu")
            return value

        here = each(numbers, args)
        named = {key: each(numbers, value) for key, value in kwargs.items()}
        there = asked_for[0] == DEVICE if asked_for else bool(given)
        self.copies_to_host += bool(given) and (not there or name in READS)
        if not given and not there:
            return function(*args, **kwargs)
        self.copies_from_host += name in COPIES and there and not all(isinstance(a, _There) for a in tensors_in(args))
        strangers = [a for a in tensors_in(args) if not isinstance(a, _There)]
        takes_numbers = name.removesuffix("_") in PAIRS | SENDS and all(a.dim() == 0 for a in strangers)
        assert not strangers or name in COPIES or takes_numbers, f"{name}: a tensor on the CPU beside one on the device"
        self.copies_from_host += len(strangers) if name in SENDS else 0
        self.operations[name] += there

        if name == "_efficientzerotensor":  # without memory, which operations below this mode would read
            function = torch.ops.aten.zeros.default

        def back(value):
            if not isinstance(value, torch.Tensor) or not there:
                return value
            self.largest = max(self.largest, value.untyped_storage().nbytes() // value.element_size())
            written = [t for t in given if t.numbers is value]
            return written[0] if written else _There(value, *devices[:1])

        return each(back, function(*here, **named))

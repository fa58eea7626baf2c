"""Several processes that train one network: who this one is, its share of the work, and sums over all of them.

Everything here is about torch.distributed's default group, and does nothing where there is none.
"""

import contextlib
import functools
import os
import socket
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

if distributed.is_available():
    # Its functions have the default group of the moment for their default, and so keep it for good where they are first
    # imported after it: its threads then outlive Python, and may abort the process.
    import torch.distributed.nn.functional

T = TypeVar("T")


def count(group: "distributed.ProcessGroup | None" = None) -> int:
    """How many processes there are; 1 where torch.distributed is not initialised."""
    if not distributed.is_available() or not distributed.is_initialized():
        return 1
    return distributed.get_world_size(group)


def rank(who: str, group: object) -> int:
    """This process's number in a group, negative where it does not belong to it. TypeError for what is no group."""
    if distributed.is_available() and group == distributed.GroupMember.NON_GROUP_MEMBER:
        return -1
    if not distributed.is_available() or not isinstance(group, distributed.ProcessGroup):
        raise TypeError(f"{who}: process_group must be a group of torch.distributed, got {group!r:.80}")
    return distributed.get_rank(group)


def is_first() -> bool:
    """Whether this process is the one that writes files."""
    return count() == 1 or distributed.get_rank() == 0


def gathered(values: Iterable[float], group: "distributed.ProcessGroup | None" = None) -> list[list[float]]:
    """These numbers of each process, in all of them."""
    if count(group) == 1:
        return [list(values)]
    device = "cuda" if distributed.get_backend(group) == "nccl" else "cpu"
    mine = torch.tensor([float(value) for value in values], dtype=torch.float64, device=device)
    of_all = [torch.empty_like(mine) for _ in range(count(group))]
    distributed.all_gather(of_all, mine, group=group)
    return [t.tolist() for t in of_all]


def sums(values: Iterable[float], group: "distributed.ProcessGroup | None" = None) -> list[float]:
    """The sums over the processes of each of these numbers, to the same bit in all of them."""
    return [sum(column) for column in zip(*gathered(values, group), strict=True)]


def mean(values: Iterable[float], samples: int) -> list[float]:
    """The mean of each of these numbers over the processes, which speak for that many samples each."""
    if count() == 1:
        return list(values)
    *totals, weight = sums([*(samples * value if samples else 0.0 for value in values), samples])
    return [total / weight for total in totals]


def share(samples: Tensor) -> Tensor:
    """This process's part of a tensor of samples or of their numbers."""
    return samples if count() == 1 else samples.tensor_split(count())[distributed.get_rank()]


def check_batches(samples: int, batch: int) -> None:
    """Raise ValueError unless every process gets a sample of every batch."""
    smallest = samples % batch or min(samples, batch)
    if smallest < count():
        raise ValueError(f"{count()} processes need as many samples in each batch, but a batch has {smallest}")


class _Loss(torch.nn.Module):
    """What DistributedDataParallel calls: the loss of a share of a batch, with the network's parameters."""

    def __init__(self, network: torch.nn.Module, loss: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.network = network
        self.loss = loss

    def forward(self, batch: Tensor) -> Tensor:
        return self.loss(batch)


def own_gpu(device: torch.device) -> torch.device:
    """This process's GPU, where "cuda" leaves open which one it is; any other device as it is."""
    if count() == 1 or device != torch.device("cuda") or torch.cuda.device_count() == 0:
        return device
    local = int(os.environ.get("LOCAL_RANK", distributed.get_rank()))
    return torch.device("cuda", local % torch.cuda.device_count())


def _name_of_gpu(device: torch.device) -> tuple[str, str]:
    """What no other GPU has."""
    return socket.gethostname(), str(torch.cuda.get_device_properties(device).uuid)


def gradient_group(device: torch.device) -> "distributed.ProcessGroup | None":
    """The group that sums gradients of tensors on this device: NCCL's where each process has a GPU of its own. None is
    the default group, which works with GPUs as well if it is gloo's; a warning says so where processes share a GPU."""
    if device.type != "cuda" or not distributed.is_nccl_available() or distributed.get_backend() != "gloo":
        return None
    gpus: list[Any] = [None] * count()
    distributed.all_gather_object(gpus, _name_of_gpu(device))
    if len(set(gpus)) < count():
        if is_first():
            shared = f"{count()} processes share {len(set(gpus))} GPU{'s' if len(set(gpus)) > 1 else ''}"
            warnings.warn(f"{shared}: gloo sums their gradients, as NCCL needs a GPU for each process", stacklevel=2)
        return None
    group: distributed.ProcessGroup | None = _nccl_group(distributed.group.WORLD)
    return group


@functools.cache
def _nccl_group(world: object) -> Any:
    """One for all trainings: each takes memory of the GPU."""
    return distributed.new_group(backend="nccl")


def shared_loss(
    network: torch.nn.Module, loss: Callable[[Tensor], Tensor], device: torch.device
) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """From `loss`, of the numbers of a batch's samples, to that of this process's share of them: (its value, its
    part of the whole loss, for the backward pass). The gradients of the parts are then those of the batch's loss."""
    if count() == 1:
        return lambda batch: (whole := loss(batch), whole)
    parallel = torch.nn.parallel.DistributedDataParallel(_Loss(network, loss), process_group=gradient_group(device))

    def of_share(batch: Tensor) -> tuple[Tensor, Tensor]:
        mine = share(batch)
        value = parallel(mine)
        return value, value * (len(mine) * count() / len(batch))  # DistributedDataParallel divides by the count

    return of_share


def from_first(make: Callable[[], T]) -> T:
    """What `make()` returns in the first process, in all of them. It is not called in the others."""
    if count() == 1:
        return make()
    box: list[Any] = [make() if is_first() else None]
    distributed.broadcast_object_list(box, src=0)
    made: T = box[0]
    return made


def first_before_others(make: Callable[[], T]) -> T:
    """`make()` of every process, called in the first one before the others: they find the files it has written."""
    if count() == 1:
        return make()
    if is_first():
        made = make()
        distributed.barrier()
        return made
    distributed.barrier()
    return make()


def launched() -> int:
    """How many processes torchrun, or who else sets its variables, has started this one among."""
    names = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
    return int(os.environ["WORLD_SIZE"]) if all(name in os.environ for name in names) else 1


@contextlib.contextmanager
def joined() -> Iterator[None]:
    """Join the others that torchrun has started, and leave them in the end. Only the first one prints meanwhile.

    RuntimeError, in one sentence, where another process has ended before its time.
    """
    if launched() == 1:
        yield
        return
    distributed.init_process_group("gloo")
    who = f"process {distributed.get_rank()} of {count()}"
    try:
        with contextlib.ExitStack() as quiet:
            if not is_first():
                nowhere = quiet.enter_context(open(os.devnull, "w"))
                quiet.enter_context(contextlib.redirect_stdout(nowhere))
                quiet.enter_context(contextlib.redirect_stderr(nowhere))
            yield
    except RuntimeError as error:
        if not _is_of_a_connection(error):
            raise
        raise RuntimeError(f"{who}: another process has ended, and this one with it") from None
    finally:
        if sys.exc_info()[0] is None:
            distributed.barrier()  # gloo may abort a process whose partner has left first
            distributed.destroy_process_group()


def _is_of_a_connection(error: RuntimeError) -> bool:
    """Whether gloo or NCCL, by words alone, says that it has lost another process."""
    return any(
        words in str(error) for words in ("gloo", "NCCL", "Connection closed", "Connection reset", "Broken pipe")
    )

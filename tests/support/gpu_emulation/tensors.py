"""Tensors of an emulated device ``cuda:0``: values are in CPU memory, the rules are those of a separate device.

An operation on emulated and CPU tensors raises RuntimeError, as on a GPU; so does ``.numpy()``, where a GPU's tensors
raise TypeError. Operations for which the host would wait are counted. There is no autograd.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

_aten = torch.ops.aten
_DEVICE = torch.device("cuda", 0)
_COPIES = {_aten.copy_.default, _aten._to_copy.default}
_TAKES_BOTH_DEVICES = _COPIES | {_aten.is_pinned.default, _aten._pin_memory.default}
_INDEXING = {_aten.index.Tensor, _aten.index_put.default, _aten.index_put_.default, _aten._index_put_impl_.default}
_SYNCHRONISING = {
    _aten._linalg_check_errors.default,
    _aten._local_scalar_dense.default,
    _aten._unique2.default,
    _aten.bincount.default,
    _aten.equal.default,
    _aten.is_nonzero.default,
    _aten.masked_select.default,
    _aten.nonzero.default,
    _aten.unique_consecutive.default,
    _aten.unique_dim.default,
}
_torch_tensor = torch.tensor
_synchronisations: Counter[str] = Counter()


@contextmanager
def count_synchronisations() -> Iterator[Counter[str]]:
    """Count the operations, by name, for which the host waits for the device within the block."""
    before, counted = _synchronisations.copy(), Counter[str]()
    try:
        yield counted
    finally:
        counted.update(_synchronisations - before)


class EmulatedTensor(torch.Tensor):
    """Tensor that reports ``cuda:0``; ``inner`` is the CPU tensor that holds its values."""

    inner: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> EmulatedTensor:
        tensor = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=_DEVICE,
        )
        tensor.inner = inner
        return tensor

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(func, args, kwargs or {})

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"{self.inner!r} on {_DEVICE}"

    def __deepcopy__(self, memo: dict[int, Any]) -> EmulatedTensor:
        return EmulatedTensor(self.inner.clone())

    def tolist(self) -> Any:
        _synchronisations["tolist"] += 1
        return self.inner.tolist()


class _FactoryMode(TorchDispatchMode):
    """Handles operations without emulated tensors, such as ``torch.zeros(2, device="cuda")``."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if not types and kwargs.get("device") is None:  # all on the CPU
            return func(*args, **kwargs)
        return _dispatch(func, args, kwargs)


def install() -> None:
    """Make ``cuda:0`` the emulated device of this process."""
    _register_device_guard()
    torch.cuda.is_available = lambda: True
    torch.cuda._lazy_init = lambda: None
    torch._C._set_only_lift_cpu_tensors(True)  # `torch.tensor` copies to the device by an operation that is dispatched
    torch.tensor = _tensor
    _FactoryMode().__enter__()


def _tensor(data: Any, **kwargs: Any) -> torch.Tensor:
    """Call ``torch.tensor``, which reads tensors within lists by an operation that is not dispatched."""
    if isinstance(data, (list, tuple)):
        _synchronisations["tensor of tensors"] += sum(isinstance(x, EmulatedTensor) for x in _tensors(data))
        data = _apply(_inner, data)
    return _torch_tensor(data, **kwargs)


def _register_device_guard() -> None:
    """Register a device guard for CUDA, which a CPU build of torch lacks: the one of ``meta``, which does nothing."""
    library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libc10.so"))
    guards = (ctypes.c_void_p * 21).in_dll(library, "_ZN3c104impl26device_guard_impl_registryE")
    cuda, meta = 1, 14  # c10::DeviceType
    if not guards[cuda]:
        guards[cuda] = guards[meta]


def _dispatch(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = list(_tensors((*args, *kwargs.values())))
    emulated = [x for x in tensors if isinstance(x, EmulatedTensor)]
    wanted = kwargs.get("device")
    to_device = _is_emulated(wanted) if wanted is not None else bool(emulated)
    if func is _aten._to_copy.default and emulated and to_device and _keeps_type(args[0], kwargs):
        return args[0]  # no copy: C++ does not know that "cuda" is "cuda:0"
    if emulated:
        _check_devices(func, args, tensors)
    _count(func, args, kwargs, to_device)
    inner_kwargs = {name: _apply(_inner, value) for name, value in kwargs.items()}
    if func is _aten._to_copy.default and wanted is not None:
        del inner_kwargs["device"]  # a copy even though both are in the same memory
    if inner_kwargs.get("pin_memory"):
        inner_kwargs["pin_memory"] = False
    result = func(*_apply(_inner, args), **inner_kwargs)
    in_place = {id(x.inner): x for x in emulated}

    def wrap(x: Any) -> Any:
        if not isinstance(x, torch.Tensor):
            return x
        if id(x) in in_place:
            if x.shape != in_place[id(x)].shape:
                raise NotImplementedError(f"the GPU emulation has no {func}, which changes a shape in place")
            return in_place[id(x)]
        return EmulatedTensor(x) if to_device and func is not _aten.copy_.default else x

    return _apply(wrap, result)


def _keeps_type(tensor: torch.Tensor, kwargs: dict[str, Any]) -> bool:
    return kwargs.get("dtype") in (None, tensor.dtype) and "memory_format" not in kwargs


def _tensors(values: Any) -> Iterator[torch.Tensor]:
    """Give the tensors in nested lists and tuples."""
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from _tensors(value)


def _apply(function: Callable[[Any], Any], value: Any) -> Any:
    """Apply a function to each value in nested lists and tuples; torch's own tree functions take four times as long."""
    if isinstance(value, (list, tuple)):
        return type(value)([_apply(function, x) for x in value])
    return function(value)


def _is_emulated(device: Any) -> bool:
    return torch.device(device).type in ("cuda", "meta")  # "meta": what the borrowed guard answers


def _inner(x: Any) -> Any:
    if isinstance(x, EmulatedTensor):
        return x.inner
    return torch.device("cpu") if isinstance(x, torch.device) and _is_emulated(x) else x


def _is_on_host(x: Any) -> bool:
    return isinstance(x, torch.Tensor) and not isinstance(x, EmulatedTensor)


def _check_devices(func: Any, args: Any, tensors: list[torch.Tensor]) -> None:
    """Raise RuntimeError where a GPU build of torch would: CPU tensors of any size but one number do not mix."""
    if func in _TAKES_BOTH_DEVICES:
        return
    if func in _INDEXING:  # the indices of a GPU tensor may be CPU tensors
        if not isinstance(args[0], EmulatedTensor):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        tensors = [x for x in (args[0], *args[2:3]) if isinstance(x, torch.Tensor)]
    in_place = func._schema.name.endswith("_") and not isinstance(tensors[0], EmulatedTensor)
    if in_place or any(x.dim() > 0 and not isinstance(x, EmulatedTensor) for x in tensors):
        raise RuntimeError(f"Expected all tensors to be on the same device, but found at least two: {func}")


def _depends_on_values(func: Any, args: Any, kwargs: dict[str, Any]) -> bool:
    """Whether an operation reads values on the device, because its arguments leave the result's size or range open."""
    if func is _aten.repeat_interleave.Tensor:
        return kwargs.get("output_size") is None
    if func is _aten.histc.default:  # equal limits, the default, stand for the smallest and the largest value
        lowest, highest = (args[i] if len(args) > i else 0 for i in (2, 3))
        return lowest == highest
    return False


def _count(func: Any, args: Any, kwargs: dict[str, Any], to_device: bool) -> None:
    """Count an operation if the host waits for it."""
    name, emulated = "", any(isinstance(x, EmulatedTensor) for x in _tensors(args))
    if func is _aten._to_copy.default and isinstance(args[0], EmulatedTensor) != to_device:
        name = "copy to the device" if to_device else "copy to the host"
    elif func is _aten.copy_.default and isinstance(args[0], EmulatedTensor) != isinstance(args[1], EmulatedTensor):
        name = "copy to the device" if isinstance(args[0], EmulatedTensor) else "copy to the host"
    elif emulated and func in _INDEXING:
        masks = [x for x in args[1] if isinstance(x, torch.Tensor) and x.dtype in (torch.bool, torch.uint8)]
        values = args[2:3]  # a number, such as in `x[i, j] = 1.0`, is a tensor on the host
        name = "index with a mask" if masks else "put a number" if any(map(_is_on_host, values)) else ""
    elif emulated and (func in _SYNCHRONISING or _depends_on_values(func, args, kwargs)):
        name = func._schema.name
    if name:
        _synchronisations[name] += 1

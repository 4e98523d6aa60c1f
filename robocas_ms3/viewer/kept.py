"""What was made last is kept, as long as it does not take too much memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence

from numpy.typing import NDArray


class KeptPictures:
    """Groups of pictures: of those used last as many as fit. For one thread at a time."""

    def __init__(self, most: int) -> None:
        """Args: most: bytes; a group that is larger is kept by itself."""
        self._most, self._size = most, 0
        self._groups: OrderedDict[Hashable, Sequence[NDArray]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Sequence[NDArray]]) -> Sequence[NDArray]:
        """The group of this key, made where it is not there."""
        if key in self._groups:
            self._groups.move_to_end(key)
            return self._groups[key]
        group = self._groups[key] = make()
        self._size += _size(group)
        while self._size > self._most and len(self._groups) > 1:
            self._size -= _size(self._groups.popitem(last=False)[1])
        return group


def _size(group: Sequence[NDArray]) -> int:
    return sum(picture.nbytes for picture in group)

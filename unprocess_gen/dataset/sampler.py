"""Order the pairs of each epoch of a training, for one process or several. Needs NumPy only."""

from __future__ import annotations

from collections.abc import Iterator

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.random_streams import shuffled


class EpochSampler:
    """Yield the items (epoch, i) of one epoch after the other, for `LivePairs`.

    Iterating yields the rest of the current epoch; after its end, the next iteration yields the next epoch. The order
    depends only on length, seed and epoch. Pass it as ``sampler`` to PyTorch's DataLoader, or iterate over it.

    Parameters
    ----------
    length : int
        Number of pairs.
    seed : int
        Seed of the order.
    shuffle : bool
        Whether each epoch has another random order; otherwise it is that of the dataset.
    rank, world : int
        Number of this process, from 0, and number of processes. Together they yield every pair of an epoch; if the
        length is no multiple of ``world``, the first pairs of the order occur twice, so that all yield equally many.
    block : int
        Number of consecutive pairs that stay together, for example those of one image (``patches`` of `LivePairs`).
        The length is a multiple of it.

    Attributes
    ----------
    state : (int, int)
        Epoch, and number of its items that were yielded. Assign it to resume. A DataLoader reads ahead: save epoch and
        batches done times batch size instead.

    Raises
    ------
    ConfigError
        If ``length``, ``rank`` or ``block`` is out of range.

    Examples
    --------
    >>> import unprocess_gen as ug
    >>> sampler = ug.EpochSampler(4, shuffle=False, rank=1, world=2)
    >>> list(sampler), list(sampler)
    ([(0, 1), (0, 3)], [(1, 1), (1, 3)])
    """

    def __init__(
        self, length: int, seed: int = 0, shuffle: bool = True, rank: int = 0, world: int = 1, block: int = 1
    ) -> None:
        if not 0 < length < 2**32:
            raise ConfigError(f"EpochSampler: length={length}: out of range; expected 1 to {2**32 - 1}")
        if not 0 <= rank < world:
            raise ConfigError(f"EpochSampler: rank={rank}: out of range; expected 0 to {world - 1} (world={world})")
        if not 0 < block <= length or length % block:
            raise ConfigError(f"EpochSampler: block={block}: out of range; expected a divisor of length={length}")
        self._blocks, self._block, self._seed, self._shuffle = length // block, block, seed, shuffle
        self._rank, self._world = rank, world
        self.state = (0, 0)

    def set_epoch(self, epoch: int) -> None:
        """Begin an epoch."""
        self.state = (epoch, 0)

    def __repr__(self) -> str:
        return f"EpochSampler(length={self._blocks * self._block}, block={self._block}, state={self.state})"

    def __len__(self) -> int:
        """Count the items of an epoch, of this process."""
        return -(-self._blocks // self._world) * self._block

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch, first = self.state
        order = shuffled(self._blocks, self._seed, epoch) if self._shuffle else range(self._blocks)
        for position in range(first, len(self)):
            self.state = (epoch, position + 1)
            number, rest = divmod(position, self._block)
            yield epoch, int(order[(number * self._world + self._rank) % self._blocks]) * self._block + rest
        self.state = (epoch + 1, 0)

"""Two devices with one address: both do what one is told, and both answer."""

from __future__ import annotations

from drivers.instruments.zaber.codec import Reply
from drivers.links.link import DeviceRefused

FEWEST = 8  # questions answered twice, and ...
PART = 0.8  # ... this part of all of them: so much no disturbed line does in set-up

Key = tuple[int, int, int | None]


class SecondDevice:
    """Judges replies that come when their question has been answered already.

    To a question whose answer does not change, one with other words than the first is from another device. Equal ones
    may be a line's echo; where nearly every question of the set-up was answered twice it is two devices as well.
    """

    def __init__(self, device: str, address: int) -> None:
        self._device, self._address = device, address
        self._first: dict[
            Key, str | None
        ] = {}  # what was answered, until the number is used again; None: it may change
        self._lasting: set[Key] = set()
        self._answers = self._again = 0
        self._judged = False

    def asked(self, key: Key, words: str) -> None:
        """A question goes out under this key."""
        self._first.pop(key, None)
        self._lasting.discard(key)
        if words.startswith("get ") and words != "get pos":
            self._lasting.add(key)

    def answered(self, reply: object) -> None:
        """The reply that was taken."""
        if isinstance(reply, Reply):
            key = reply.device, reply.axis, reply.id
            self._first[key] = reply.data if key in self._lasting else None
            self._answers += not self._judged

    def heard_again(self, reply: object) -> None:
        """Another one that nobody waits for.

        Raises
        ------
        DeviceRefused
            It answers what was answered, with other words.
        """
        key = (reply.device, reply.axis, reply.id) if isinstance(reply, Reply) else None
        if key is None or key not in self._first:
            return
        self._again += not self._judged
        first = self._first[key]
        if isinstance(reply, Reply) and first is not None and reply.data != first:
            raise self._refusal(f": one question got the answers {first!r} and {reply.data!r}")

    def judge_all(self) -> None:
        """Judge the set-up as a whole; from now on only replies with other words count.

        Raises
        ------
        DeviceRefused
            Nearly everything was answered twice.
        """
        self._judged = True
        again, answers = self._again, self._answers
        if again >= FEWEST and again >= PART * answers:
            raise self._refusal(f": {again} of {answers} questions were answered twice")

    def _refusal(self, why: str) -> DeviceRefused:
        return DeviceRefused(
            self._device,
            f"two devices have the address {self._address}{why}",
            "They would move together. Connect one at a time and give each its own address in the maker's software "
            "(set comm.address). Nothing was moved.",
        )

"""Reading server-sent events line by line, without I/O."""

from prtbake_storage.contract.jobs import Event


class EventReader:
    """Turn lines of ``text/event-stream`` into events.

    Attributes
    ----------
    last_id
        Id of the last whole event, for ``Last-Event-ID`` when the stream is opened again.
    """

    def __init__(self, last_id: int | None = None) -> None:
        self.last_id = last_id
        self._data: list[str] = []

    def headers(self) -> dict[str, str]:
        """Return the headers that open the stream where it broke off."""
        asked = {"Accept": "text/event-stream"}
        if self.last_id is not None:
            asked["Last-Event-ID"] = str(self.last_id)
        return asked

    def feed(self, line: str) -> Event | None:
        """Take one line; return an event when it completes one.  Comments are heartbeats."""
        if line.startswith("data:"):
            self._data.append(line[5:].removeprefix(" "))
            return None
        if line or not self._data:
            return None
        event = Event.model_validate_json("\n".join(self._data))
        self._data.clear()
        self.last_id = event.id
        return event

from prtbake.sse import EventReader

DATA = '{"id": 4, "job": "j", "type": "log", "data": {"message": "x"}, "created": "2026-01-01T00:00:00Z"}'


def test_lines_make_events() -> None:
    reader = EventReader()
    assert "Last-Event-ID" not in reader.headers()
    quiet = ["retry: 1000", "", ": heartbeat", "", "id: 4", "event: log", f"data: {DATA}"]
    assert [reader.feed(line) for line in quiet] == [None] * len(quiet)
    event = reader.feed("")
    assert event is not None
    assert event.data == {"message": "x"}
    assert reader.headers()["Last-Event-ID"] == "4"
    assert reader.feed("") is None


def test_data_over_several_lines() -> None:
    reader = EventReader(2)
    first, second = DATA[:30], DATA[30:]
    # a line break may stand where JSON allows white space
    cut = first.rindex(" ")
    reader.feed(f"data: {first[:cut]}")
    reader.feed(f"data:{first[cut:]}{second}")
    event = reader.feed("")
    assert event is not None
    assert event.id == 4


def test_half_an_event_is_none() -> None:
    reader = EventReader(2)
    reader.feed(f"data: {DATA}")
    assert reader.last_id == 2

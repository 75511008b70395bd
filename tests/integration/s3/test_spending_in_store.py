"""What was spent, in an object store: an object an entry, whose name says it all."""

from schemas.outcome import NOTHING, Spent
from workers.state.checkpoint_store import RECORDS, CheckpointStore
from workers.state.cost_log import SpendingLog, spent_so_far


def test_what_was_spent_is_counted_from_names_alone_and_outlives_the_records(store):
    records = store / RECORDS
    assert spent_so_far(store) == NOTHING
    CheckpointStore(records).write("shard-00000/scene.observe.0123456789abcdef", b"record")
    for log in (SpendingLog(store), SpendingLog(store)):
        log.add(Spent(calls=1))
        log.add(Spent(0, 900, 40, 1.25e-05))
    assert spent_so_far(store) == Spent(2, 1800, 80, 2.5e-05)
    CheckpointStore(records).forget(0)
    assert spent_so_far(store) == Spent(2, 1800, 80, 2.5e-05)

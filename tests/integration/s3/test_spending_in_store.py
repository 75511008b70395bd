"""What was spent, in an object store: an object an entry, whose name says it all."""

from schemas.outcome import NO_COST, ModelCost
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore
from workers.state.cost_log import CostLog, sum_costs


def test_what_was_spent_is_counted_from_names_alone_and_outlives_the_records(store):
    records = store / CHECKPOINTS
    assert sum_costs(store) == NO_COST
    CheckpointStore(records).write("shard-00000/scene.observe.0123456789abcdef", b"record")
    for log in (CostLog(store), CostLog(store)):
        log.add(ModelCost(calls=1))
        log.add(ModelCost(0, 900, 40, 1.25e-05))
    assert sum_costs(store) == ModelCost(2, 1800, 80, 2.5e-05)
    CheckpointStore(records).delete(0)
    assert sum_costs(store) == ModelCost(2, 1800, 80, 2.5e-05)

"""Folders of results: resumed exactly, and nobody else's is touched."""

import json
import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small_experiment import experiment

from rhp_drake.errors import InputError
from rhp_drake.evaluation import experiment as experiments
from rhp_drake.evaluation import results as module
from rhp_drake.evaluation.results import read_results, run_experiment
from rhp_drake.files import exclusive
from rhp_drake.resources import models_path
from rhp_drake.workers import RayCluster

CHANGING = ["decision_seconds", "world_seconds"]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Batches of two instances."""
    monkeypatch.setattr(experiments, "BATCH_SIZE", 2)


def work(**changes):
    values = {"num_instances": 6, "levels": ["none", "high"]}
    return experiment(["random", "gp"], **values | changes)


def rows_of(folder) -> pa.Table:
    """All that depends on the experiment, sorted."""
    table = pq.read_table(folder / "episodes").drop_columns(CHANGING)
    keys = ["policy", "weights", "level", "trial", "instance"]
    return table.sort_by([(key, "ascending") for key in keys])


def run(folder, work, workers=1):
    return list(run_experiment(folder, work, workers, "a commit", "a machine"))


def test_a_folder_is_a_table(tmp_path):
    assert run(tmp_path / "out", work()) == [*range(0, 25, 2)]
    table = rows_of(tmp_path / "out")
    assert table.num_rows == 24
    assert set(table["policy"].to_pylist()) == {"random", "gp"}
    assert set(table["weights"].to_pylist()) == {"", "best"}
    read = read_results(tmp_path / "out")
    assert (read.commits, read.machines) == (["a commit"], ["a machine"])
    trial, episode = read.episodes[0]
    assert (str(trial.column), trial.level, trial.index) == ("random", "none", 0)
    assert episode.states.shape == (episode.num_actions + 1, 12)
    assert [t.index for t, _ in read.episodes] == [*range(6)] * 4


def test_columns_are_in_the_order_of_the_papers_table(tmp_path):
    """Whatever was run first."""
    for policies, weights in ((["rhp33", "gp"], ["best"]), (["kdp", "gp"], ["paper"])):
        run(tmp_path, experiment(policies, weights, num_instances=1, levels=["none"]))
    columns = dict.fromkeys(str(t.column) for t, _ in read_results(tmp_path).episodes)
    assert list(columns) == ["kdp", "gp paper", "gp best", "rhp33 best"]


def test_pandas_reads_it(tmp_path):
    pandas = pytest.importorskip("pandas")
    run(tmp_path / "out", work(num_instances=2))
    frame = pandas.read_parquet(tmp_path / "out/episodes")
    assert len(frame) == 8
    assert (frame.groupby("policy").size() == 4).all()


def test_stopped_work_goes_on_and_comes_to_the_same(tmp_path):
    run(tmp_path / "whole", work())
    stopped = tmp_path / "stopped"
    running = run_experiment(stopped, work(), 1)
    for done in running:
        if done == 8:
            break
    running.close()
    # What a killed process leaves.
    (stopped / "episodes/.gp_best_none_00_000.parquet.1.tmp").write_text("half")
    assert run(stopped, work(), workers=2)[0] == 8
    assert rows_of(stopped).equals(rows_of(tmp_path / "whole"))
    assert not list(stopped.rglob("*.tmp"))


def test_a_folder_grows(tmp_path):
    out = tmp_path / "out"
    run(out, work(num_instances=3, levels=["high"]))
    # The last batch was half a one.
    assert run(out, work(num_instances=5, levels=["none"]))[0] == 0
    assert run(out, work(num_instances=5, levels=["none", "high"]))[0] == 14
    assert (
        run(out, work(num_instances=5, num_trials=2, levels=["none", "high"]))[0] == 20
    )
    run(tmp_path / "once", work(num_instances=5, num_trials=2))
    assert rows_of(out).equals(rows_of(tmp_path / "once"))
    assert read_results(out).settings["levels"] == ["none", "high"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1}, "holds results of seed 0, not 1; choose another folder"),
        ({"world": "station"}, "holds results of world 'planar', not 'station'"),
        ({"instances": "evaluation"}, "of instances 'validation', not 'evaluation'"),
    ],
)
def test_results_of_another_experiment_are_kept(changes, message, tmp_path):
    run(tmp_path, work(num_instances=2))
    before = rows_of(tmp_path)
    with pytest.raises(InputError, match=message):
        run(tmp_path, work(num_instances=2, **changes))
    assert rows_of(tmp_path).equals(before)


def test_other_weights_of_the_same_name_are_refused(tmp_path):
    out = tmp_path / "out"
    run(out, experiment(num_instances=1))
    other = experiment(weights=["imitation"], num_instances=1)
    (config,) = other.columns.values()
    disguised = experiment(num_instances=1)
    disguised.columns.update(dict.fromkeys(disguised.columns, config))
    message = r"of another policy 'gp best' \(q_network_sha256 '\w+', not '\w+'\); "
    with pytest.raises(InputError, match=message):
        run(out, disguised)


def test_policies_whose_files_would_have_the_same_name_are_refused(tmp_path):
    weights = tmp_path / "rescue_best.safetensors"
    shutil.copy(models_path() / "q_network/best.safetensors", weights)
    out = tmp_path / "out"
    run(out, experiment(["gp_rescue"], num_instances=1))
    with pytest.raises(InputError, match="files of the name 'gp_rescue_best'; rename"):
        run(out, experiment(["gp"], [str(weights)], num_instances=1))


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("Years of work")
    with pytest.raises(InputError, match="is no folder of results"):
        run(tmp_path, work())
    with pytest.raises(InputError, match=r"there is no settings\.json"):
        read_results(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(InputError, match="is no folder of results"):
        run(tmp_path / "thesis.tex", work())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: "not JSON", "not readable settings"),
        (lambda text: json.dumps(["a list"]), "not readable settings"),
        (lambda text: text.replace("results 1", "results 9"), "has the format"),
        (lambda text: text.replace('"seed"', '"sed"'), "lacks 'seed'"),
        (lambda text: text.replace('"policy"', '"p"'), "a column lacks 'policy'"),
    ],
)
def test_damaged_settings(damage, message, tmp_path):
    run(tmp_path, work(num_instances=2))
    path = tmp_path / "settings.json"
    path.write_text(damage(path.read_text()))
    damaged = path.read_text()
    for read in (lambda: run(tmp_path, work()), lambda: read_results(tmp_path)):
        with pytest.raises(InputError, match=message):
            read()
    assert path.read_text() == damaged


def test_damaged_episodes(tmp_path):
    run(tmp_path, work(num_instances=2))
    path = min((tmp_path / "episodes").iterdir())
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 255
    path.write_bytes(content)
    for read in (lambda: run(tmp_path, work()), lambda: read_results(tmp_path)):
        with pytest.raises(InputError, match=f"{path.name}: not a readable file"):
            read()
    assert path.read_bytes() == content


def test_files_that_do_not_belong_there(tmp_path):
    out, other = tmp_path / "out", tmp_path / "other"
    run(out, work(num_instances=2, levels=["none"]))
    run(other, work(num_instances=2, levels=["low"]))
    copy = out / "episodes/gp_best_none_00_000 (copy).parquet"
    shutil.copy(out / "episodes/gp_best_none_00_000.parquet", copy)
    with pytest.raises(InputError, match="holds episodes that another file has, too"):
        read_results(out)
    shutil.copy(other / "episodes/gp_best_low_00_000.parquet", copy)
    with pytest.raises(InputError, match=r"of gp best \(low\), which settings\.json"):
        read_results(out)
    pq.write_table(pq.read_table(copy).drop_columns("outcome"), copy)
    with pytest.raises(InputError, match=r"copy.*: lacks the column 'outcome'"):
        read_results(out)


def test_one_process_a_folder(tmp_path):
    with exclusive(tmp_path), pytest.raises(InputError, match="another process works"):
        run(tmp_path, work())


def test_an_empty_folder_holds_no_results(tmp_path):
    run(tmp_path, work(num_instances=2))
    for path in (tmp_path / "episodes").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="holds no episodes yet"):
        read_results(tmp_path)


@pytest.mark.slow
def test_a_cluster_that_loses_a_node_comes_to_the_same(tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    mortal = cluster.add_node(num_cpus=1)
    try:
        ray = RayCluster(cluster.address)
        for done in run_experiment(tmp_path / "cluster", work(), ray):
            if done == 12:
                # As if someone had pulled its plug.
                cluster.remove_node(mortal, allow_graceful=False)
    finally:
        cluster.shutdown()
    run(tmp_path / "alone", work())
    assert rows_of(tmp_path / "cluster").equals(rows_of(tmp_path / "alone"))
    assert module.read_results(tmp_path / "cluster").episodes

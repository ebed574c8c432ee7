"""The machine that numbers were made on."""

from importlib.metadata import version
import platform


def describe_machine(num_workers: int | None = 1) -> str:
    """One line: processor, cores, workers and the versions that matter to speed.

    Args:
        num_workers: Processes; None for those of a cluster.
    """
    model = platform.processor() or platform.machine()
    cores = 0
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            lines = file.readlines()
        models = [x.split(":", 1)[1].strip() for x in lines if "model name" in x]
        model, cores = models[0], len(models)
    except (OSError, IndexError):
        pass  # Not Linux: say what Python knows.
    return (
        f"{model}, {cores or '?'} cores, {num_workers or 'a cluster of'} worker(s), "
        f"Python {platform.python_version()}, drake {version('drake')}, "
        f"torch {version('torch')}"
    )

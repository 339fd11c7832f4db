"""The options of the commands that can divide their work among many workers."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from socast.core.errors import SettingsError
from socast.tools.cluster.dask_runner import ClusterPlace, parse_place
from socast.tools.terminal.option_groups import insert_options
from socast.tools.terminal.output import check_outputs

WORKER_MEMORY_GB = 2.0


def make_place(
    *,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="WHERE",
            help="Divide the work among N processes (local:N), or the workers of a Dask scheduler (tls://host:8786).",
        ),
    ] = None,
    worker_memory: Annotated[
        float, typer.Option(metavar="GB", help="Memory of each process of local:N.", min=0.5, max=1e4)
    ] = WORKER_MEMORY_GB,
    cluster_report: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write which task of --cluster ran where.")
    ] = None,
) -> ClusterPlace | None:
    """Return where the work is done; None for this process."""
    if cluster is None:
        if cluster_report is not None:
            raise SettingsError("--cluster-report says what ran where with --cluster; give that too, or leave it out")
        return None
    check_outputs((), cluster_report)
    return replace(parse_place(cluster, worker_memory), report=cluster_report)


insert_cluster_options = insert_options("place", make_place, "Cluster")
"""Decorator that gives a command the options of a cluster in place of its argument `place`."""

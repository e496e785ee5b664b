"""sweep(): one scene file over a grid or table of its values, streamed to one HDF5 file; merge(): shards put together.

A sweep of any size runs in bounded memory, chunk by chunk, and goes on after a kill where it stopped.

**The values.** Keys are those of the scene file with dots, `rod.EI` or `loads.point_force.0.at`; one component of a
vector goes by its number, `end.position.2`. Values are as the scene file has them, or plain numbers in SI units. A
grid is TOML; its cases are the product of all keys, the last key fastest:

    "rod.EI" = [0.004, 0.005]
    "end.position" = ["[70, 0, 0] cm", [0.8, 0, 0]]
    "rod.length" = { from = "0.9 m", to = 1.2, count = 11 }                      # equal steps
    "rod.EA" = { from = "80 N", to = "8 kN", count = 3, spacing = "log" }        # equal factors

A table is CSV: a header of keys, then one row a case. Cases count from 0. All are solved on the mesh of
`[solve] segments`; without it, on as many equal segments as the first case needs for `[solve] rtol`, and those that
need more again on meshes 2, 4, 8, ... times as fine. What misses `rtol` on the finest is counted.

**The result**, HDF5, first axis the case: `case` its number, `status`, `converged`, `stable`, `iterations`, `residual`,
`error_estimate`, `force_error`, `moment_error`, `curvature_error` of the mesh, `energy`, `elastic_energy`,
`total_twist`, `start_force`, `start_moment`, `end_force`, `end_moment`, `nodes` (cases, segments + 1, 3), as in
`rodjax.Equilibrium`, `segments` of the mesh of each case (its `nodes` are those that the coarsest mesh has), and
`parameters/<key>` in SI units; each has the attributes `units` and `description`. Attributes of the file: the texts
`scene` and `over`, and what is in `rodjax.sweeps.manifest.Manifest`, with its `fingerprint`.

**Of a harness** (`rodjax.io.harness_file`) keys begin with `cables.NAME` or `joints.NAME`: `cables.trunk.rod.EI`,
`joints.y.mass`. What is of a rod is then in groups, `cables/NAME/end_force`, and there is `joints/NAME/position`;
`energy`, `status` and the like are those of the whole, the errors those of the cable whose are largest; `segments` is
that of every cable. In tables columns are `cables.NAME.end_force.0 [N]`. Cases are solved one after another.

Further quantities are written where they are asked for (`also=["bend_radius", "clip_forces"]`, `--also
bend_radius,clip_forces`): `bend_radius` the smallest one of the centerline, `clearance` to each obstacle, `clip_forces`
and `clip_moments` of each clip, `obstacle_forces` of each obstacle, `largest_tension`, `least_tension`,
`largest_strain`.

**Tables**: `rodjax sweep --csv OUT.csv` and `--parquet OUT.parquet` (pyarrow: `pip install 'rodjax[parquet]'`) write
all but the nodes as a table too, one row a case, one column a number, named with its unit: `end.position.2 [m]`,
`bend_radius [m]`. `write_csv` and `write_parquet` of `rodjax.sweeps.result` make them of a finished sweep, and its
`columns` gives what `pandas.DataFrame` takes.

**On the way** there is a folder beside the result, named like it with `.parts`: `manifest.json`, which says what is
solved, and `chunk-<number>.h5` for each finished chunk, with the datasets of the result; and a file with `.lock`, by
which a second process is told that one is at work. Chunks are the same whatever the shard, whoever solves them and
wherever a run was stopped, and the last one is filled up with its last case: one compiled program, and the same bits in
the end.
"""

# ruff: noqa: T201
"""Run by test_compiled.py in a process of its own: the CUDA field in numba's simulator against NumPy; prints the error."""


def main() -> None:
    """Imports stand here: the simulator is for this process alone, and pytest looks into every file."""
    import dataclasses
    import json
    import os

    os.environ["NUMBA_ENABLE_CUDASIM"] = "1"

    import numpy as np

    from aerpaw_cmp.propagation import channel, compiled_field, cuda_field, kernels
    from aerpaw_cmp.propagation.bench import random_scene
    from aerpaw_cmp.propagation.scene import Scene
    from aerpaw_cmp.propagation.tracer import replay
    from aerpaw_cmp.site.antennas import TR38901, HalfWaveDipole, Isotropic

    site, link, poses = random_scene(300, towers=2)
    found = replay(site, link, poses).paths
    rows = np.concatenate([np.flatnonzero(found.depth == d)[:3] for d in (0, 1, 2)])
    few = found.select(np.sort(rows))
    scene = Scene.of(site, link, poses)
    patterns = (Isotropic(), HalfWaveDipole(), TR38901(), TR38901())
    tower = dataclasses.replace(next(iter(link.tower_arrays.values())), patterns=patterns)
    link = dataclasses.replace(
        link,
        tower_arrays=dict.fromkeys(link.tower_arrays, tower),
        uav_array=dataclasses.replace(link.uav_array, patterns=patterns),
    )
    loss = np.linspace(0.0, 9.0, len(few))
    os.environ["AERPAW_CMP_COMPILED"] = "never"
    numpy = channel.channel_matrices(few, scene.faces, scene.sources_m, poses, link, loss)
    tables = channel.FaceMaterials.of(scene.faces, link.carrier_hz)
    electric = tables.permittivity, tables.thickness_m
    cuda_field._batch = lambda *_: 4  # several batches, the last one not full
    h, power = compiled_field.evaluate(
        kernels, few, scene.faces, electric, scene.sources_m, poses, link, loss, device="cuda"
    )
    print(
        json.dumps(
            {
                "depths": sorted(set(few.depth.tolist())),
                "h": float(np.abs(h - numpy.h).max() / np.abs(numpy.h).max()),
                "power": float(np.abs(power / numpy.path_power - 1).max()),
            }
        )
    )


if __name__ == "__main__":
    main()

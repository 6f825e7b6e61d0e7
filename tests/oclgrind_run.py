"""Render a few pixels on the only device there is: what test_oclgrind.py runs under the simulator.

Usage: oclgrind_run.py SCENE INTEGRAND METHOD SAMPLER VEC LANES [DENSITY [VISIBILITY [LISTED [RAYS]]]]
"""

import sys
from dataclasses import replace

from fitting import fitting

from ncv_cl import render
from ncv_cl.learning import tuning
from ncv_cl.opencl.device import list_cl_devices, open_device
from ncv_cl.opencl.limits import DeviceMemory
from ncv_cl.opencl.memory import HostArray
from ncv_cl.rendering import prepare
from ncv_cl.sampling import paths
from ncv_cl.settings.presets import PRESETS
from ncv_cl.visibility import slices
from ncv_cl.visibility import tuning as visibility_tuning


def avoid_false_reports() -> None:
    """Work around what oclgrind 21.10 does not follow when it looks for uninitialised memory.

    It takes what clEnqueueFillBuffer wrote for uninitialised; and where a released buffer's number is
    given to a larger one, it takes the larger one's end for uninitialised.
    """
    kept = []
    create = HostArray.__init__

    def create_and_keep(array, *arguments, **options):
        create(array, *arguments, **options)
        kept.append(array.buffer)

    def fill_from_host(array, value):
        with array.mapped(write=True) as view:
            view[...] = value

    HostArray.__init__ = create_and_keep
    HostArray.fill = fill_from_host


def shrink_training() -> None:
    """The default network with fewer grid levels and one pass: every line of the kernels still runs."""
    tuning.FEWEST_STEPS = tuning.FEWEST_STEPS_OF_ONE_BATCH = 1
    preset = PRESETS["default"]
    schedule = replace(preset.schedule, epochs=1)
    PRESETS["default"] = replace(preset, hidden=(8, 4), grid_levels=2, schedule=schedule)


def take_slices() -> None:
    """Of few samples already, and by few slices that tell what they cost."""
    slices.COUNTED_SLICES = 32
    visibility_tuning.FEWEST_SLICES, visibility_tuning.SAMPLES_A_TRIANGLE = 1, 0


def main(
    scene: str,
    integrand: str,
    method: str,
    sampler: str,
    vec: str,
    lanes: str,
    density: str | None = None,
    visibility: str = "auto",
    listed: str = "",
    rays: str = "auto",
) -> None:
    """Render; `listed` is how many occluders a list may hold, if not as many as usual.

    With `rays` "ahead" they are the device's, and nobody waits for how many of a path there are.
    """
    if listed:
        prepare.MOST_ON_LINES = int(listed)
    avoid_false_reports()
    shrink_training()
    if visibility == "slices":
        take_slices()
        visibility = "auto"
    (simulator,) = list_cl_devices()
    # An explicit device: choosing one would run the micro-benchmark in the simulator.
    device = open_device(simulator, vector_width=int(vec), lanes=int(lanes))
    if rays == "ahead":
        rays, paths.WAVES = "device", 2
        memory = DeviceMemory(False, device.memory.largest, device.memory.total)
        device = replace(device, memory=memory)
    image = render(
        scene,
        integrand,
        spp=4,
        size=(4, 4),
        device=device,
        visibility=visibility,
        rays=rays,
        **fitting(method, sampler=sampler, train_spp=2, density=density),
    )
    print(f"{device.name}: {image.stats['points']} points, mean {float(image.pixels.mean())!r}")


if __name__ == "__main__":
    main(*sys.argv[1:])

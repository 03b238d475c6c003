"""Run all benchmarks one after another: `python -m benchmarks [--quick] [--kitti FOLDER] [--json FILE]`.

`python -m benchmarks.NAME`, e.g. `benchmarks.odometry`, runs only one of them, with the same options.
"""

from benchmarks import footprint, odometry, posenet, report, simulation, training

if __name__ == "__main__":
    report.main(
        __doc__,
        odometry=odometry.measure,
        posenet=posenet.measure,
        training=training.measure,
        simulation=simulation.measure,
        footprint=footprint.measure,
    )

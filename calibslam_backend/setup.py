"""Installation of calibslam_backend; executables go to lib/calibslam_backend/ for `ros2 run`."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "calibslam_backend"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(glob("config/*.yaml"))),
        (f"share/{PACKAGE}/rviz", sorted(glob("rviz/*.rviz"))),
        (f"share/{PACKAGE}/foxglove", sorted(glob("foxglove/*.json"))),
    ],
    package_data={PACKAGE: ["py.typed"]},
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="CalibSLAM maintainers",
    maintainer_email="maintainers@calibslam.invalid",
    description="Object SLAM from boxes that carry their own covariances: geometry, factors, map.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"backend = {PACKAGE}.backend_node:main",
            f"slam_bag = {PACKAGE}.slam_bag:main",
        ],
        "calibslam.reference_boxes": [f"default = {PACKAGE}.reference_boxes:of_recording"],
    },
)

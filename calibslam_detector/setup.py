"""Installation of calibslam_detector; executables go to lib/calibslam_detector/ for `ros2 run`."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "calibslam_detector"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(glob("config/*.yaml"))),
    ],
    package_data={PACKAGE: ["py.typed", "default_weights/*"]},
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="CalibSLAM maintainers",
    maintainer_email="maintainers@calibslam.invalid",
    description="Boxes with calibrated covariances: a detector and its training, and a calibrator for any detector.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"calibrator = {PACKAGE}.calibrator_node:main",
            f"detect_bag = {PACKAGE}.detect_bag:main",
            f"detection2d = {PACKAGE}.detection2d_node:main",
            f"detector = {PACKAGE}.detector_node:main",
            f"evaluate_detector = {PACKAGE}.evaluate_detector:main",
            f"fit_calibrator = {PACKAGE}.fit_calibrator:main",
            f"train = {PACKAGE}.train:main",
        ],
        "calibslam.calibrators": [f"default = {PACKAGE}.foreign_boxes.calibrator:load"],
    },
)

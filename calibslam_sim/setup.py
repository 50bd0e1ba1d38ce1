"""Installation of calibslam_sim; executables go to lib/calibslam_sim/ for `ros2 run`."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "calibslam_sim"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(glob("config/*.yaml"))),
        (f"share/{PACKAGE}/launch", sorted(glob("launch/*.xml"))),
    ],
    package_data={PACKAGE: ["py.typed"]},
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="CalibSLAM maintainers",
    maintainer_email="maintainers@calibslam.invalid",
    description="Simulated worlds, odometry, bags, replay and evaluation for CalibSLAM.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"demo = {PACKAGE}.demo:main",
            f"draw_run = {PACKAGE}.draw_run:main",
            f"evaluate = {PACKAGE}.evaluate:main",
            f"experiment = {PACKAGE}.experiment:main",
            f"export_rerun = {PACKAGE}.export_rerun:main",
            f"odometry = {PACKAGE}.odometry_node:main",
            f"parameters = {PACKAGE}.parameters:main",
            f"play = {PACKAGE}.play_node:main",
            f"record = {PACKAGE}.record_node:main",
            f"render_dataset = {PACKAGE}.render_dataset:main",
            f"report = {PACKAGE}.report:main",
            f"results = {PACKAGE}.results:main",
            f"save_map = {PACKAGE}.save_map_node:main",
            f"simulate = {PACKAGE}.simulate:main",
            f"tum_to_bag = {PACKAGE}.tum_to_bag:main",
            f"visual_odometry = {PACKAGE}.visual_odometry_node:main",
            f"visual_odometry_bag = {PACKAGE}.visual_odometry_bag:main",
        ],
    },
)

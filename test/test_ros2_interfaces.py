"""What the official `ros2` command line relies on, through rclpy and the ament index.

`ros2 pkg`, `run` and `interface` read the ament index; `ros2 node`, `param`, `service` and `topic` ask the graph and
the parameter services of a node. Each node is started with its own parameter file.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import ExitStack
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import torch
import yaml
from ament_index_python import get_package_prefix, get_package_share_directory, get_packages_with_prefixes, get_resource
from live import Process, Watcher, executable, random_domain, wait_until
from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from calibslam_detector.model import weights_file
from calibslam_detector.model.network import CalibratedDetector
from calibslam_msgs_py.parameter_files import NodeParameters
from calibslam_sim import parameters

PROJECT = Path(__file__).resolve().parents[1]
PACKAGES = ("calibslam_msgs", "calibslam_backend", "calibslam_detector", "calibslam_sim")
NODES = {node.executable: node for node in parameters.nodes()}
# What rclpy declares by itself.
OWN_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides.")
SERVICES = {
    "/backend/reset": "std_srvs/srv/Trigger",
    "/backend/pause": "std_srvs/srv/SetBool",
    "/backend/save_map": "calibslam_msgs/srv/SaveMap",
    "/backend/load_map": "calibslam_msgs/srv/LoadMap",
}
TOPICS = {
    "/trajectory": "nav_msgs/msg/Path",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/quadrics": "calibslam_msgs/msg/QuadricArray",
    "/quadric_markers": "visualization_msgs/msg/MarkerArray",
}


# -- the ament index ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", PACKAGES)
def test_pkg(package: str) -> None:
    """`ros2 pkg list | prefix | xml`; installed package.xml and setup.py agree with the source."""
    assert package in get_packages_with_prefixes()
    manifest = Path(get_package_share_directory(package), "package.xml")
    root = ElementTree.parse(manifest).getroot()
    assert (root.findtext("name"), root.findtext("license")) == (package, "Apache-2.0")
    assert manifest.read_text() == (PROJECT / package / "package.xml").read_text()


def test_run() -> None:
    """`ros2 run PKG EXE`: every entry point is an executable file in lib/PKG, and nothing else is."""
    expected: dict[str, set[str]] = {}
    for point in entry_points(group="console_scripts"):
        package = point.module.partition(".")[0]
        if package.startswith("calibslam_"):
            expected.setdefault(package, set()).add(point.name)
    assert expected.keys() == set(PACKAGES[1:])
    for package, names in expected.items():
        files = list(Path(get_package_prefix(package), "lib", package).iterdir())
        assert {file.name for file in files} == names
        assert all(os.access(file, os.X_OK) and file == executable(package, file.name) for file in files)


def test_parameter_files_are_installed() -> None:
    """For `--params-file $(ros2 pkg prefix --share PKG)/config/NODE.yaml`."""
    for node in NODES.values():
        installed = Path(get_package_share_directory(node.package), "config", f"{node.executable}.yaml")
        assert installed.read_text() == (PROJECT / node.package / "config" / installed.name).read_text()


def test_interface() -> None:
    """`ros2 interface list | show`: each is in the index, has its text in share, and a Python class."""
    content, _ = get_resource("rosidl_interfaces", "calibslam_msgs")
    share = Path(get_package_share_directory("calibslam_msgs"))
    sources = {
        f"{file.parent.name}/{file.name}" for kind in ("msg", "srv") for file in (share / kind).glob(f"*.{kind}")
    }
    assert sources == {f"{f.parent.name}/{f.name}" for f in PROJECT.glob("calibslam_msgs/[ms]*/*.[ms][sr][gv]")}
    assert sources <= set(content.splitlines())
    for name in sources:
        kind, _, file = name.partition("/")
        found = getattr(importlib.import_module(f"calibslam_msgs.{kind}"), Path(file).stem)
        assert found.__name__ == Path(file).stem


# -- the graph ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watcher]:
    """Every node that has parameters, each started with its parameter file."""
    folder = tmp_path_factory.mktemp("nodes")
    torch.manual_seed(4)
    weights_file.save(CalibratedDetector("compact", ("cup", "book")), folder / "weights.pt")
    needed = {"detector": [f"weights:={folder / 'weights.pt'}"], "record": [f"out:={folder / 'run.mcap'}"]}
    domain = random_domain()
    with ExitStack() as stack:
        watcher = stack.enter_context(Watcher(domain))
        processes = {}
        for name, node in NODES.items():
            options = ["--ros-args", "--params-file", str(PROJECT / node.package / "config" / f"{name}.yaml")]
            for parameter in needed.get(name, ()):
                options += ["-p", parameter]
            processes[name] = stack.enter_context(Process(domain, node.package, name, *options))
        for name, process in processes.items():
            wait_until(
                lambda n=name, p=process: watcher.sees(f"/{n}") or not p.running,
                lambda n=name: f"no node /{n}",
            )
            assert process.running, process.output
        yield watcher
        for process in processes.values():
            assert process.running, process.output


def listed(graph: Watcher, name: str) -> list[str]:
    """As `ros2 param list` asks, without what rclpy declares by itself."""
    names = graph.call(ListParameters, f"/{name}/list_parameters").result.names
    return [each for each in names if not each.startswith(OWN_OF_ROS)]


@pytest.mark.parametrize("name", NODES)
def test_param(name: str, graph: Watcher) -> None:
    """`ros2 param list | describe | get | set`."""
    values = yaml.safe_load((PROJECT / NODES[name].package / "config" / f"{name}.yaml").read_text())
    expected = values["/**"]["ros__parameters"]
    del expected["use_sim_time"]
    names = listed(graph, name)
    assert set(names) == expected.keys()
    described = graph.call(DescribeParameters, f"/{name}/describe_parameters", names=names).descriptors
    got = graph.call(GetParameters, f"/{name}/get_parameters", names=names).values
    settings = fields_of(NODES[name])
    for descriptor, value in zip(described, got, strict=True):
        field, kind = settings[descriptor.name]
        assert descriptor.read_only
        assert descriptor.description.startswith(str(field.metadata["meaning"]))
        assert f"[{field.metadata['unit']}]" in descriptor.description or not field.metadata["unit"]
        check_range(descriptor, field.metadata, kind)
        if descriptor.name not in ("weights", "out"):
            assert parameter_value_to_python(value) == expected[descriptor.name], descriptor.name
        check_type(value.type, kind)
    refused = graph.call(SetParameters, f"/{name}/set_parameters", parameters=[Parameter(name=names[0], value=got[0])])
    assert not refused.results[0].successful and "read-only" in refused.results[0].reason


def fields_of(node: NodeParameters) -> dict[str, tuple[Any, type]]:
    return {field.name: (field, kind) for _, fields in node.groups() for field, kind in fields}


def check_type(given: int, kind: type) -> None:
    expected = {
        bool: ParameterType.PARAMETER_BOOL,
        int: ParameterType.PARAMETER_INTEGER,
        float: ParameterType.PARAMETER_DOUBLE,
        str: ParameterType.PARAMETER_STRING,
    }
    assert given == expected[kind]


def check_range(descriptor: ParameterDescriptor, metadata: Any, kind: type) -> None:
    """What `ros2 param describe` prints as "Min value" and "Max value", and the choices of a text."""
    low, high = metadata["low"], metadata["high"]
    if low is not None or high is not None:
        (found,) = descriptor.floating_point_range if kind is float else descriptor.integer_range
        assert low is None or found.from_value == low
        assert high is None or found.to_value == high
    assert all(choice in descriptor.additional_constraints for choice in metadata["choices"])


def test_service(graph: Watcher) -> None:
    """`ros2 service list -t | call`: names and types are in the graph, the classes behind the types can be called."""
    there = dict(graph.node.get_service_names_and_types())
    for name, kind in SERVICES.items():
        assert there[name] == [kind]
        package, _, service = kind.split("/")
        response = graph.call(getattr(importlib.import_module(f"{package}.srv"), service), name)
        assert isinstance(response.success, bool) and response.message


def test_topic(graph: Watcher) -> None:
    """`ros2 topic list -t | info -v`: maps are reliable and transient local, as in the documentation."""
    there = dict(graph.node.get_topic_names_and_types())
    for topic, kind in TOPICS.items():
        assert there[topic] == [kind]
        info = next(i for i in graph.node.get_publishers_info_by_topic(topic) if i.node_name == "backend")
        assert info.topic_type == kind
        assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def test_node_info(graph: Watcher) -> None:
    """`ros2 node info /backend`."""
    subscribed = dict(graph.node.get_subscriber_names_and_types_by_node("backend", "/"))
    expected = {
        "/detections": "calibslam_msgs/msg/BoundingBoxArray",
        "/relative_pose": "calibslam_msgs/msg/RelativePose",
        "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    }
    assert expected.items() <= {name: kinds[0] for name, kinds in subscribed.items()}.items()
    published = dict(graph.node.get_publisher_names_and_types_by_node("backend", "/"))
    assert TOPICS.keys() | {"/diagnostics"} <= published.keys()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("nosie_model: fixed", "unknown parameter nosie_model"),
        ("map_period: -1.0", "map_period"),
        ("map_period: x", "map_period"),
    ],
)
def test_bad_parameter_files_are_refused(line: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "backend.yaml"
    text = (PROJECT / "calibslam_backend/config/backend.yaml").read_text()
    kept = [each for each in text.splitlines() if not each.startswith(f"    {line.partition(':')[0]}:")]
    file.write_text("\n".join([*kept, f"    {line}"]))
    with Process(random_domain(), "calibslam_backend", "backend", "--ros-args", "--params-file", str(file)) as process:
        assert process.wait() == 2, process.output
        assert "error: " in process.output and said in process.output and "Traceback" not in process.output


@pytest.mark.parametrize(
    ("name", "outputs"),
    {
        "backend": list(TOPICS),
        "calibrator": ["/detections"],
        "detector": ["/detections", "/detector/overlay/compressed"],
        "odometry": ["/relative_pose"],
        "visual_odometry": ["/relative_pose"],
    }.items(),
)
def test_qos_overrides(name: str, outputs: list[str], graph: Watcher) -> None:
    """Every output's quality of service is a parameter."""
    names = graph.call(ListParameters, f"/{name}/list_parameters").result.names
    for output in outputs:
        for policy in ("depth", "durability", "history", "reliability"):
            assert f"qos_overrides.{output}.publisher.{policy}" in names


@pytest.mark.parametrize("node", sorted(NODES.keys() - {"record"}))
def test_security_policy(graph: Watcher, node: str) -> None:
    """`docs/policy.xml` allows what a node does, and nothing else but what depends on its settings and on tf2."""
    profile = ElementTree.parse(PROJECT / "docs" / "policy.xml").find(f".//enclave[@path='/calibslam/{node}']//profile")
    assert profile is not None and (profile.get("ns"), profile.get("node")) == ("/", node)
    depends = {"/clock", "/tf", "/odom", "/ground_truth"}
    for kind, rule, ask in (
        ("topic", "publish", graph.node.get_publisher_names_and_types_by_node),
        ("topic", "subscribe", graph.node.get_subscriber_names_and_types_by_node),
        ("service", "reply", graph.node.get_service_names_and_types_by_node),
    ):
        names = [element.text or "" for element in profile.findall(f"{kind}s[@{rule}='ALLOW']/{kind}")]
        allowed = {name.replace("~", f"/{node}") if name[0] in "/~" else f"/{name}" for name in names}

        def used(ask: Any = ask) -> set[str]:
            return {name for name, _ in ask(node, "/")}

        wait_until(lambda a=allowed, u=used: a - depends <= u(), lambda u=used: f"{node}: {sorted(u())}")
        assert used() <= allowed

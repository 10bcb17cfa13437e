"""ROS 2 on the wire: types, bytes, names and hashes as ROS has them, and messages between participants of DDS."""

import numpy as np
import pytest
from loopback import surroundings

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")
pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: messages of ROS are not tested")
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from maexp.agents.ros2.dds import TOPICS, Wire, quality, read_domain
from maexp.agents.ros2.messages import CLASSES, TABLE, wire_name

STORE = get_typestore(Stores.ROS2_JAZZY)


def told(about) -> str:
    """A field's type in the words of the table."""
    kind, rest = about
    if kind == Nodetype.NAME:
        return rest.replace("/msg/", "/")
    if kind == Nodetype.BASE:
        return rest[0]
    inner, count = rest
    return f"{told(inner)}[{count if kind == Nodetype.ARRAY else ''}]"


@pytest.mark.parametrize("name", TABLE)
def test_a_message_holds_what_ros_says(name):
    assert TABLE[name] == ", ".join(f"{told(about)} {field}" for field, about in STORE.fielddefs[name][1])


@pytest.mark.parametrize("release", ["HUMBLE", "IRON", "JAZZY", "KILTED"])
def test_definitions_are_the_same_in_every_release(release):
    store = get_typestore(Stores[f"ROS2_{release}"])
    assert all(store.fielddefs[name][1] == STORE.fielddefs[name][1] for name in TABLE)


def filled(name: str, rng: np.random.Generator):
    """A message of ours with a value in every field."""
    message = CLASSES[name]()
    for field, (kind, about) in STORE.fielddefs[name][1]:
        if kind == Nodetype.NAME:
            value = filled(about, rng)
        elif kind == Nodetype.BASE:
            value = draw(about[0], rng)
        else:
            (inner, what), count = about
            several = range(count or 5)
            value = [filled(what, rng) if inner == Nodetype.NAME else draw(what[0], rng) for _ in several]
        setattr(message, field, value)
    return message


def draw(kind: str, rng: np.random.Generator):
    if kind == "string":
        return "".join(rng.choice(list("abc/_"), rng.integers(1, 12)))
    return float(np.float32(rng.normal())) if kind.startswith("float") else int(rng.integers(0, 100))


@pytest.mark.parametrize("name", TABLE)
def test_the_bytes_are_those_of_ros(name):
    """Both ways, so that alignment, lengths of text and sequences are right."""
    message = filled(name, np.random.default_rng(5))
    raw = message.serialize()
    theirs = STORE.deserialize_cdr(raw, name)
    assert bytes(STORE.serialize_cdr(theirs, name)) == raw
    assert CLASSES[name].deserialize(raw) == message
    assert CLASSES[name]() != message and len(raw) > 8


def test_first_values_are_those_of_ros():
    turn = CLASSES["geometry_msgs/msg/TransformStamped"]().transform.rotation
    assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0)


def test_names_on_the_wire():
    assert wire_name("std_msgs/msg/Header") == "std_msgs::msg::dds_::Header_"
    for name, made in CLASSES.items():
        assert made.__idl__.idl_transformed_typename == wire_name(name)


@pytest.mark.parametrize("name", TOPICS)
def test_hashes_of_definitions(name):
    kind = TOPICS[name]
    assert STORE.hash_rihs01(kind.message) == f"RIHS01_{kind.hash}"
    assert f"typehash=RIHS01_{kind.hash};".encode() in str(quality(kind, reads=False)).encode()


@pytest.fixture
def alone(monkeypatch):
    for name, value in surroundings().items():
        monkeypatch.setenv(name, value)


def wait_for(wire, reader, seconds=10.0):
    """The first messages that come."""
    for _ in range(int(10 * seconds)):
        wire.wait(0.1)
        if found := list(reader.take()):
            return found
    raise AssertionError("nothing came")


def test_a_map_reaches_who_comes_later(alone):
    here, there = Wire(), Wire()
    writer = here.writer("/a/map")
    for number in (7, 8):
        message = writer.make()
        message.header.stamp.sec, message.data = number, [-1, 0, 100]
        writer.write(message)
    reader = there.reader("/a/map")
    (got,) = wait_for(there, reader)
    assert got.header.stamp.sec == 8 and list(got.data) == [-1, 0, 100]
    assert reader.matched and writer.matched and writer.settle(5.0)
    assert not there.reader("/b/map").matched


def test_a_goal_is_delivered_once(alone):
    here, there = Wire(), Wire()
    writer, reader = here.writer("/a/goal_pose"), there.reader("/a/goal_pose")
    while not (writer.matched and reader.matched):
        there.wait(0.05)
    message = writer.make()
    message.header.frame_id, message.pose.position.x = "map", 1.5
    writer.write(message)
    (got,) = wait_for(there, reader)
    assert got == message and not list(reader.take())


def test_domains_that_are_none(monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert read_domain(None) == 0 and read_domain(42) == 42
    with pytest.raises(ValueError, match="domain=233 must be a whole number from 0 to 232"):
        read_domain(233)
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    with pytest.raises(ValueError, match="ROS_DOMAIN_ID=seven must be"):
        Wire()


def test_a_network_that_is_none(monkeypatch):
    monkeypatch.setenv(
        "CYCLONEDDS_URI",
        "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='none9'/>"
        "</Interfaces></General></Domain></CycloneDDS>",
    )
    with pytest.raises(ValueError, match="DDS does not start in domain 231.*CYCLONEDDS_URI"):
        Wire(231)

"""ROS 2 on the wire: types, bytes, names and hashes as ROS has them, and messages between participants of DDS."""

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="THE EXTRA maexp[ros2] IS NOT INSTALLED: DDS is not tested")
pytest.importorskip("rosbags", reason="THE EXTRA maexp[rosbag] IS NOT INSTALLED: messages of ROS are not tested")
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from maexp.agents.deploy.ros2.dds import TOPICS, Wire, quality, read_domain
from maexp.agents.deploy.ros2.messages import CLASSES, HEADER, NAVIGATE, TABLE, wire_name

GOAL = "geometry_msgs/PoseStamped pose\nstring behavior_tree"
PROGRESS = """geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining"""
ERRORS = "\nfloat32 position_tracking_error\nfloat32 heading_tracking_error"
ACTIONS = {
    "humble": (GOAL, "std_msgs/Empty result", PROGRESS),
    "iron": (GOAL, "uint16 error_code", PROGRESS),
    "kilted": (GOAL, "uint16 error_code\nstring error_msg", PROGRESS),
    "main": (GOAL, "uint16 error_code\nstring error_msg", PROGRESS + ERRORS),
}
"""NavigateToPose.action by releases of nav2: goal, result, feedback, without comments and constants."""


UPDATE = {
    "map_msgs/msg/OccupancyGridUpdate": "std_msgs/Header header\nint32 x\nint32 y\n"
    "uint32 width\nuint32 height\nint8[] data"
}
"""Of map_msgs, the same since Foxy."""


def services(action: tuple[str, str, str]) -> dict[str, str]:
    """What ROS makes of an action, and the one service that all actions share (action_msgs/srv/CancelGoal.srv)."""
    goal, result, feedback = action
    uuid = "unique_identifier_msgs/UUID goal_id"
    return {
        f"{NAVIGATE}_Goal": goal,
        f"{NAVIGATE}_Result": result,
        f"{NAVIGATE}_Feedback": feedback,
        f"{NAVIGATE}_SendGoal_Request": f"{uuid}\n{NAVIGATE}_Goal goal",
        f"{NAVIGATE}_SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp",
        f"{NAVIGATE}_GetResult_Request": uuid,
        f"{NAVIGATE}_GetResult_Response": f"int8 status\n{NAVIGATE}_Result result",
        f"{NAVIGATE}_FeedbackMessage": f"{uuid}\n{NAVIGATE}_Feedback feedback",
        "action_msgs/srv/CancelGoal_Request": "action_msgs/GoalInfo goal_info",
        "action_msgs/srv/CancelGoal_Response": "int8 return_code\naction_msgs/GoalInfo[] goals_canceling",
    }


def store_of(release: Stores, action: str):
    """The definitions of a release; requests and responses with the header that `rmw_cyclonedds` puts before them."""
    store = get_typestore(release)
    for name, text in {**services(ACTIONS[action]), **UPDATE}.items():
        before = "uint64 guid\nint64 seq\n" if name.endswith(("_Request", "_Response")) else ""
        (definition,) = get_types_from_msg(before + text, name).values()
        store.register({name: definition})
    return store


STORE = store_of(Stores.ROS2_JAZZY, "main")


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
    holds = ", ".join(f"{told(about)} {field}" for field, about in STORE.fielddefs[name][1])
    assert TABLE[name] == holds.removeprefix(HEADER)
    assert holds.startswith(HEADER) == name.endswith(("_Request", "_Response"))


@pytest.mark.parametrize("release", ["HUMBLE", "IRON", "JAZZY", "KILTED"])
def test_definitions_are_the_same_in_every_release(release):
    store = store_of(Stores[f"ROS2_{release}"], "main")
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
            value = bytes(value) if about[0][1] == ("uint8", 0) else value  # as cyclonedds has them
        setattr(message, field, value)
    return message


def draw(kind: str, rng: np.random.Generator):
    if kind == "string":
        return "".join(rng.choice(list("abc/_"), rng.integers(1, 12)))
    if kind == "bool":
        return True
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


@pytest.mark.parametrize("action", ["humble", "iron", "kilted"])
@pytest.mark.parametrize("name", [name for name in TABLE if name.endswith(("_Request", "_Response", "Message"))])
def test_an_older_nav2_reads_the_part_that_it_knows(name, action):
    """What grew has grown at the end: the bytes of the older definition begin those of ours."""
    raw, older = filled(name, np.random.default_rng(5)).serialize(), store_of(Stores.ROS2_HUMBLE, action)
    theirs = STORE.deserialize_cdr(raw, name)
    known = bytes(older.serialize_cdr(cut(theirs, name, older), name))
    assert raw[: len(known)] == known and len(known) > 8
    assert (len(raw) > len(known)) == (name in GROWN[action])


FEEDBACK, RESULT = f"{NAVIGATE}_FeedbackMessage", f"{NAVIGATE}_GetResult_Response"
GROWN = {"humble": (FEEDBACK, RESULT), "iron": (FEEDBACK, RESULT), "kilted": (FEEDBACK,)}


def cut(message, name: str, older):
    """A message of `STORE` as one of an older release."""
    values = {}
    for field, (kind, about) in older.fielddefs[name][1]:
        if about == "std_msgs/msg/Empty":
            values[field] = older.types[about]()  # the byte of nothing is where ours pads
        elif kind == Nodetype.NAME and about in older.fielddefs:
            values[field] = cut(getattr(message, field), about, older)
        elif kind == Nodetype.SEQUENCE:
            values[field] = [cut(item, about[0][1], older) for item in getattr(message, field)]
        else:
            values[field] = getattr(message, field)
    return older.types[name](**values)


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
    if name == "feedback":  # grows with releases
        assert not kind.hash and "typehash" not in str(quality(kind, reads=False))
        return
    assert STORE.hash_rihs01(kind.message) == f"RIHS01_{kind.hash}"
    assert f"typehash=RIHS01_{kind.hash};".encode() in str(quality(kind, reads=False)).encode()


def wait_for(wire, reader, seconds=10.0):
    """The first messages that come."""
    for _ in range(int(10 * seconds)):
        wire.wait(0.1)
        if found := list(reader.take()):
            return found
    raise AssertionError("nothing came")


def test_a_map_reaches_who_comes_later(own_domain):
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


def test_a_goal_is_delivered_once(own_domain):
    here, there = Wire(), Wire()
    writer, reader = here.writer("/a/goal_pose"), there.reader("/a/goal_pose")
    while not (writer.matched and reader.matched):
        there.wait(0.05)
    message = writer.make()
    message.header.frame_id, message.pose.position.x = "map", 1.5
    writer.write(message)
    (got,) = wait_for(there, reader)
    assert got == message and not list(reader.take())


SEND = "/a/navigate_to_pose/_action/send_goal"


def test_a_service_answers_who_asks(own_domain):
    here, there, elsewhere = Wire(), Wire(), Wire()
    server, clients = here.server(SEND), [there.client(SEND), elsewhere.client(SEND)]
    assert here.server(SEND) is server, "two would both answer"
    while not all(client.matched for client in clients):
        there.wait(0.05)
    numbers = [client.ask() for client in (clients[0], *clients)]
    assert numbers == [1, 2, 1]
    asked = []
    while len(asked) < 3:
        here.wait(0.1)
        asked += server.take()
    for question in asked:
        server.answer(question, accepted=question.guid == clients[0].guid)
    for wire, client, accepted, count in ((there, clients[0], True, 2), (elsewhere, clients[1], False, 1)):
        got = []
        while len(got) < count:
            wire.wait(0.1)
            got += client.take()
        assert [answer.seq for answer in got] == [1, 2][:count] and all(answer.accepted == accepted for answer in got)


def test_names_of_services_on_the_wire(own_domain):
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription

    wire = Wire()
    client = wire.client(SEND)
    wrote, reads = (
        [endpoint for endpoint in BuiltinDataReader(wire.participant, topic).take(9) if SEND in endpoint.topic_name]
        for topic in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription)
    )
    kind = "nav2_msgs::action::dds_::NavigateToPose_SendGoal_"
    assert [(endpoint.topic_name, endpoint.type_name) for endpoint in wrote] == [
        (f"rq{SEND}Request", f"{kind}Request_")
    ]
    assert [(endpoint.topic_name, endpoint.type_name) for endpoint in reads] == [(f"rr{SEND}Reply", f"{kind}Response_")]
    assert not client.matched and "clientid=" in str(wrote[0].qos) and str(wrote[0].qos).count("Reliable")


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

"""Definitions of message types with units and frames."""

from instant_ic.msg import typestore
from instant_ic.msg.definition import definition, expanded_definition, own_types, ros_fields


def test_nested_types_are_expanded_and_comments_kept():
    assert expanded_definition("velodyne_msgs/msg/VelodyneScan") == (
        "# The raw packets of one revolution (layout of the ros-drivers message of this name).\n"
        'std_msgs/Header header                  # frame "velodyne"; stamp of the first packet\n'
        "\tbuiltin_interfaces/Time stamp\n\t\tint32 sec\n\t\tuint32 nanosec\n\tstring frame_id\n"
        "velodyne_msgs/VelodynePacket[] packets  # in the order of arrival\n"
        "\tbuiltin_interfaces/Time stamp\n\t\tint32 sec\n\t\tuint32 nanosec\n\tuint8[1206] data"
    )


def test_a_comment_of_two_lines_stays_with_its_field():
    lines = expanded_definition("Keyframe").splitlines()
    sigma = next(number for number, line in enumerate(lines) if line.startswith("sensor_msgs/Image sigma"))
    assert lines[sigma + 1].lstrip().startswith("# 0.002") and lines[sigma + 2] == "\tstd_msgs/Header header"


def test_every_type_has_a_definition_and_every_field_of_ours_a_comment():
    for name in typestore().types:
        assert definition(name) or name.endswith("/Empty")
    bare = {
        f"{name}: {line}"
        for name in own_types()
        for line in definition(name).splitlines()
        if "=" not in line.split("#")[0] and "#" not in line
    }
    assert bare <= {
        "instant_ic_msgs/msg/ControlState: uint8 mode", "instant_ic_msgs/msg/ControlState: bool estop",
    }  # fmt: skip


def test_comments_on_ros_types_name_existing_fields():
    for name, comments in ros_fields().items():
        fields = {field for field, _ in typestore().get_msgdef(name).fields}
        assert comments.keys() <= fields | {"about"}, name

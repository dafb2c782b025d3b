r"""A node of ROS 2: depth images and their camera in, poses of parts out.

python examples/ros2/ibi_node.py --ros-args -p model:=part.stl -p unit:=mm \
    -r depth:=/camera/depth/image_rect_raw -r camera_info:=/camera/depth/camera_info

Listens to `depth` (sensor_msgs/Image) and `camera_info` (sensor_msgs/CameraInfo), publishes `detections`
(vision_msgs/Detection3DArray) in the frame of the image, best score first. Of the images that come while one
is searched, the newest is the next. Needs rclpy, message_filters, rosidl_runtime_py and vision_msgs.
"""

import ibi_rs as ibi
import message_filters
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosidl_runtime_py import set_message_fields
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection3DArray

PARAMETERS = {
    "model": "",  # mesh of the part
    "unit": "mm",  # of the mesh
    "symmetries": True,  # look for them: poses do not jump then
    "min_score": 0.9,
    "max_instances": 20,
    "timeout_s": 2.0,
    "voxel": 0.0,  # in the unit of the mesh; 0: by the mesh
}


class Finder(Node):
    """Finds a part in each depth image."""

    def __init__(self):
        super().__init__("ibi")
        of = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        self.unit, self.min_score = of["unit"], of["min_score"]
        self.limits = {name: of[name] for name in ("max_instances", "timeout_s")}
        self.part = ibi.Model.from_mesh(
            *ibi.io.read_mesh(of["model"]),
            voxel=of["voxel"] or None,
            symmetries="find" if of["symmetries"] else None,
        )
        self.last = None
        self.found = self.create_publisher(Detection3DArray, "detections", 10)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        both = [
            message_filters.Subscriber(self, kind, name, qos_profile=newest)
            for kind, name in ((Image, "depth"), (CameraInfo, "camera_info"))
        ]
        self.images = message_filters.TimeSynchronizer(both, queue_size=1)
        self.images.registerCallback(self.search)

    def search(self, image, camera_info):
        """Search an image, and publish what is found; what cannot be searched is a line in the log."""
        try:
            view = ibi.ros.view(image, camera_info, unit=self.unit)
            found = self.part.detect(view.points, viewpoint=view, reference=self.last, **self.limits)
        except ibi.InputError as error:
            self.get_logger().error(str(error))
            return
        for warning in found.warnings:
            self.get_logger().warning(warning)
        self.last = found
        stamp = image.header.stamp.sec, image.header.stamp.nanosec
        fields = ibi.ros.detection3d_array(
            found.at_least(self.min_score),
            image.header.frame_id,
            stamp=stamp,
            unit=self.unit,
            models=self.part,
        )
        message = Detection3DArray()
        set_message_fields(message, fields)
        self.found.publish(message)


def main():
    """Search until Ctrl-C."""
    rclpy.init()
    node = Finder()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

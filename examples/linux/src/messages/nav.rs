//! `nav_msgs/Path` and `nav_msgs/Odometry` of ROS 2, field by field.

use cara_std::Variables;

/// `builtin_interfaces/Time`.
#[derive(Variables, Clone, Debug, Default, PartialEq)]
pub struct Time {
    pub sec: i32,
    pub nanosec: u32,
}

/// `std_msgs/Header`.
#[derive(Variables, Clone, Debug, Default, PartialEq)]
pub struct Header {
    pub stamp: Time,
    #[size(64)]
    pub frame_id: String,
}

/// `geometry_msgs/Point` and `geometry_msgs/Vector3`.
#[derive(Variables, Clone, Debug, Default, PartialEq)]
pub struct Vector3 {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

/// `geometry_msgs/Quaternion`.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Quaternion {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
}

/// `geometry_msgs/Pose`.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Pose {
    pub position: Vector3,
    pub orientation: Quaternion,
}

/// `geometry_msgs/PoseStamped`.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct PoseStamped {
    pub header: Header,
    pub pose: Pose,
}

/// `geometry_msgs/PoseWithCovariance`.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct PoseWithCovariance {
    pub pose: Pose,
    /// Row-major, of x, y, z and the rotations about them.
    pub covariance: [f64; 36],
}

/// `geometry_msgs/Twist`.
#[derive(Variables, Clone, Debug, Default, PartialEq)]
pub struct Twist {
    pub linear: Vector3,
    pub angular: Vector3,
}

/// `geometry_msgs/TwistWithCovariance`.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct TwistWithCovariance {
    pub twist: Twist,
    /// As of [`PoseWithCovariance`].
    pub covariance: [f64; 36],
}

/// `nav_msgs/Path`.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Path {
    pub header: Header,
    #[size(200)]
    pub poses: Vec<PoseStamped>,
}

/// `nav_msgs/Odometry`.
#[derive(Variables, Clone, Debug, PartialEq)]
pub struct Odometry {
    pub header: Header,
    #[size(64)]
    pub child_frame_id: String,
    pub pose: PoseWithCovariance,
    pub twist: TwistWithCovariance,
}

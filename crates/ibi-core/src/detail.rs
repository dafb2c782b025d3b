//! How closely a pose is looked at.

/// How many source points are looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Detail {
    /// 64, enough to see that a pose is hopeless; with a camera 256, of which it sees less than half.
    Glance,
    /// 256, enough to judge it; with a camera all.
    Look,
}

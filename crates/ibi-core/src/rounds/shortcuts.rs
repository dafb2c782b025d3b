//! Which shortcuts a run takes.

/// What saves time, all of it by default; without it the same poses are found. For tests and benches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(clippy::exhaustive_structs, reason = "not part of the stable surface")]
pub struct Shortcuts {
    /// The seeds of the next round are selected while this one is played, by a thread that would be idle.
    pub ahead: bool,
    /// A pose that was judged before, or comes to lie where one was, is not judged again.
    pub memory: bool,
    /// What a few points show to be hopeless is not looked at closely.
    pub glance: bool,
}

#[cfg(feature = "internals")]
impl Shortcuts {
    /// None of them.
    pub const NONE: Self = Self { ahead: false, memory: false, glance: false };
}

impl Default for Shortcuts {
    fn default() -> Self {
        Self { ahead: true, memory: true, glance: true }
    }
}

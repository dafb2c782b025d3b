//! Empty: see `benches`.

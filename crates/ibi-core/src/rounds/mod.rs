//! What surrounds the paper's round: its state, what speeds it up, and what becomes of the poses that it finds.
//!
//! | room | why it is there |
//! |---|---|
//! | `state` | what is alive, what was found, what happened; when a run ends; removal |
//! | `stages` | asks the stages: each told to the watcher, timed, and not begun once the run is to end |
//! | `judge` | polishes a pose and validates it |
//! | `candidates`, `contest` | poses that passed wait for better ones of the same instance |
//! | `closely` | looks at a pose on all that was measured before it becomes an instance |
//! | `turns` | tries a pose the other ways round before it becomes an instance |
//! | `joint` | at the end all poses compete for the scene at once |
//! | `lastly` | the last polish on all that was measured |
//! | `ranking` | makes the result |
//!
//! The shortcuts save time and can be left out one by one ([`Shortcuts`]):
//!
//! | shortcut | saves | results |
//! |---|---|---|
//! | `ahead` | an idle second thread selects the seeds of the next round | the same bits |
//! | `memory` | a pose that was judged before is not judged again | the same poses |
//! | `glance` | a hopeless pose is not looked at closely | the same poses |

mod ahead;
mod candidates;
mod closely;
mod contest;
mod glance;
mod instances;
mod joint;
mod judge;
mod lastly;
mod memory;
mod problem;
mod ranking;
mod shortcuts;
mod stages;
mod state;
mod timed;
mod turns;

pub(crate) use problem::Problem;
pub use shortcuts::Shortcuts;
pub(crate) use stages::Stages;
pub(crate) use state::Play;
pub use state::State;

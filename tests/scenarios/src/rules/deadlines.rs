//! Every call ends with its deadline.

use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::RequestOptions;

use super::{Bystander, pair};
use crate::scenario::scenarios;
use crate::{Service, World, millis, number, secs};

scenarios![
    a_time_out_frees_its_slot_and_the_late_reply_is_dropped: "48", Rough, [ThirdUnit], ["CallsTimedOut", "RepliesLate"];
    the_time_out_can_be_changed_while_running: "48", Rough, [], ["CallsTimedOut"];
];

fn a_time_out_frees_its_slot_and_the_late_reply_is_dropped(world: &mut dyn World) {
    let service = Service::new("slow(n: int[1]) -> (n: int[1])").does(|_, parameters| {
        parameters.set_value("n", 99_i64).map_err(|_| cara_core::error::ServiceError::BadResults)
    });
    let (manager, _agv) = pair(world, &service.takes(millis(40)));
    let mut bystander = Bystander::add(world, &manager);
    let options = RequestOptions { timeout: Some(millis(20)), ..RequestOptions::default() };
    // More calls than the table has slots: one that leaked its slot would fill it.
    for _ in 0..70 {
        let mut parameters = number("n", 1);
        let start = world.now();
        let asked = world.ask_with(&manager, "agv", "slow", &mut parameters, options);
        if asked == Ok(()) && !world.is_virtual() {
            // This machine was so busy that the deadline was not checked before the reply was there.
            continue;
        }
        // The callee counts the way as age, so it may find a call too old a little before its caller does.
        assert!(matches!(asked, Err(Error::TimedOut | Error::Expired)), "{asked:?}");
        assert_eq!(parameters, number("n", 1), "an error leaves the parameters as they are");
        if let Some(slack) = world.slack() {
            assert!(world.now().since(start) <= millis(20) + slack);
        }
        world.run_for(millis(25));
        bystander.continues(world, &manager);
    }
    world.wait("late replies are counted", || manager.counted(LinkCounter::RepliesLate) > 0, secs(10));
    let mut parameters = number("n", 1);
    assert_eq!(world.ask(&manager, "agv", "slow", &mut parameters), Ok(()));
    assert_eq!(parameters, number("n", 99));
}

fn the_time_out_can_be_changed_while_running(world: &mut dyn World) {
    let (manager, _agv) = pair(world, &Service::new("slow(n: int[1]) -> (n: int[1])").takes(secs(2)));
    manager.change(|limits| limits.request_timeout = millis(100));
    let defaults = RequestOptions::default();
    let asked = world.ask_with(&manager, "agv", "slow", &mut number("n", 1), defaults);
    assert!(matches!(asked, Err(Error::TimedOut | Error::Expired)), "{asked:?}");
    manager.change(|limits| limits.request_timeout = secs(20));
    assert_eq!(world.ask_with(&manager, "agv", "slow", &mut number("n", 1), defaults), Ok(()));
}

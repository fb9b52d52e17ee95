//! What moves is an actuator: units of the simulator have it, its latch and hearts as those of the other ports do.

use super::*;
use cara_core::config::Priority;
use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::lease::{Latch, LeaseEnd};
use cara_core::services::session::RequestOptions;
use cara_sim::{Actuator, UnitEvent};

const LEASE: Duration = Duration::from_millis(400);
const WANTED: RequestOptions = RequestOptions::renewing(Renew::Process);

/// A crane with one drive, and two m_units that want to move it.
struct Yard {
    world: World,
    crane: UnitHandle,
    drive: Actuator,
    hooks: Rc<RefCell<u32>>,
    /// What each order's handler could commit: at once, and when the order of another call had begun.
    committed: Rc<RefCell<Vec<bool>>>,
    callers: [UnitHandle; 2],
}

fn yard() -> Yard {
    let mut world = World::new(1);
    let callers = [1, 2].map(|id| world.m_unit("depot", id).start());
    let crane = world.m_unit("crane", 7).start();
    let ((hooks, counted), (committed, commits)) = (shared(0), shared(Vec::new()));
    let drive = Actuator::new(move |_| *counted.borrow_mut() += 1);
    let moves = || {
        let commits = Rc::clone(&commits);
        let service = Service::future(move |call, parameters| {
            let commits = Rc::clone(&commits);
            async move {
                let commit = || commits.borrow_mut().push(call.commit(|| ()).is_ok());
                commit();
                call.unit.sleep(millis(300)).await;
                commit();
                Ok(parameters)
            }
        });
        service.moves(&drive, LEASE)
    };
    let plain = || Service::new(|_, _| Ok(()));
    let list = crane.my_function_list();
    list.add_service("go()", moves()).unwrap();
    list.add_service("dock()", moves()).unwrap();
    list.add_service("halt()", plain().stops(&drive).priority(Priority::Emergency)).unwrap();
    list.add_service("go_on()", plain().resets(&drive)).unwrap();
    crane.publish_my_function_list().unwrap();
    let know = |caller: &UnitHandle| caller.knows("crane", "go_on");
    assert!(world.run_until(|_| callers.iter().all(know), secs(10)));
    Yard { world, crane, drive, hooks, committed, callers }
}

impl Yard {
    fn call(&mut self, caller: usize, function: &str, options: RequestOptions) -> Result<(), Error> {
        let mut none = Parameters::new();
        self.world.block_on(self.callers[caller].block_request_with("crane", function, &mut none, options))
    }

    fn request(&self, function: &str, options: RequestOptions) {
        self.callers[0].request_with("crane", function, &Parameters::new(), options).unwrap();
    }

    fn is_live(&self) -> bool {
        self.drive.is_live(&self.crane)
    }

    fn hooks(&self) -> u32 {
        *self.hooks.borrow()
    }

    fn is_reported(&self, caller: usize, end: LeaseEnd) -> bool {
        self.callers[caller].count(|event| matches!(event, UnitEvent::LeaseEnded { why, .. } if *why == end)) == 1
    }
}

#[test]
fn an_order_is_replaced_by_its_own_caller_and_held_against_others_unless_taken_over() {
    let mut yard = yard();
    yard.request("go", WANTED);
    yard.world.run_for(millis(100));
    yard.request("dock", WANTED);
    yard.world.run_for(millis(500));
    assert_eq!(*yard.committed.borrow(), [true, true, false, true], "the first was replaced");
    assert!(yard.is_reported(0, LeaseEnd::Replaced));
    assert_eq!(yard.call(1, "go", WANTED), Err(Error::Held { by: 1, operator: false }));
    assert_eq!(yard.call(1, "go", RequestOptions { take_over: true, ..WANTED }), Ok(()));
    assert_eq!((yard.is_live(), yard.hooks()), (true, 0));
}

#[test]
fn what_the_program_of_a_unit_moves_is_held_against_its_operator_and_the_reverse() {
    let mut yard = yard();
    let operators = RequestOptions { operator: true, ..WANTED };
    assert_eq!(yard.call(0, "go", WANTED), Ok(()));
    assert_eq!(yard.call(0, "dock", operators), Err(Error::Held { by: 1, operator: false }));
    assert_eq!(yard.call(0, "dock", RequestOptions { take_over: true, ..operators }), Ok(()));
    assert!(yard.is_reported(0, LeaseEnd::Replaced));
    for caller in [0, 1] {
        assert_eq!(yard.call(caller, "go", WANTED), Err(Error::Held { by: 1, operator: true }));
    }
    assert_eq!(yard.call(0, "go", operators), Ok(()));
    assert_eq!((yard.is_live(), yard.hooks()), (true, 0));
}

#[test]
fn a_stop_of_another_unit_has_the_hook_run_before_its_handler_and_a_reset_undoes_it() {
    let mut yard = yard();
    yard.call(0, "go", WANTED).unwrap();
    yard.world.run_for(secs(2));
    assert!(yard.is_live() && yard.call(1, "halt", RequestOptions::new()).is_ok());
    assert_eq!((yard.is_live(), yard.hooks()), (false, 1), "at once, though it is the order of another link");
    yard.world.run_for(millis(10));
    assert!(yard.is_reported(0, LeaseEnd::Stopped));
    assert_eq!(yard.call(0, "go", WANTED), Err(Error::Inhibited { by: 2, reason: 0 }));
    assert_eq!(yard.call(0, "go_on", RequestOptions::new()), Ok(()));
    assert_eq!(yard.call(0, "go", WANTED), Ok(()));
}

#[test]
fn a_vehicle_stops_itself() {
    let mut yard = yard();
    yard.call(0, "go", WANTED).unwrap();
    yard.drive.inhibit(&yard.crane, 3);
    yard.world.run_for(Duration::ZERO);
    assert_eq!((yard.is_live(), yard.hooks(), yard.drive.latch()), (false, 1, Some(Latch { by: 0, reason: 3 })));
    assert_eq!(yard.call(0, "go", WANTED), Err(Error::Inhibited { by: 0, reason: 3 }));
    yard.world.run_for(millis(10));
    yard.drive.reset(&yard.crane);
    assert_eq!(yard.call(0, "go", WANTED), Ok(()));
}

#[test]
fn what_a_loop_wants_ends_with_its_beats_and_what_is_held_with_its_guard() {
    let mut yard = yard();
    let mut heart = yard.callers[0].heart(LEASE.divided_by(2));
    heart.beat();
    yard.request("go", RequestOptions::renewing(heart.renew()));
    for _ in 0..20 {
        heart.beat();
        yard.world.run_for(millis(100));
    }
    assert!(yard.is_live());
    yard.world.run_for(millis(300));
    assert_eq!((yard.is_live(), yard.hooks()), (false, 1), "it hangs");
    heart.beat();
    yard.request("go", RequestOptions::renewing(heart.renew()));
    yard.world.run_for(millis(10));
    assert!(yard.is_live());
    drop(heart);
    yard.world.run_for(millis(10));
    assert_eq!((yard.is_live(), yard.hooks()), (false, 2));
    let mut none = Parameters::new();
    let hold = yard.world.block_on(yard.callers[0].hold("crane", "go", &mut none, WANTED)).unwrap();
    yard.world.run_for(secs(1));
    assert!(yard.is_live());
    drop(hold);
    yard.world.run_for(millis(10));
    assert_eq!((yard.is_live(), yard.hooks()), (false, 3));
}

//! A vehicle that a gateway drives: a point that moves at a constant speed, and actions that take a while.
//!
//! Its output is what really happens: `drive 4 b`, `arrived b`, `stood 1.25`, `act 5 pick-1`, `ended pick-1 FINISHED`.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cara_std::{AnyCall, Interfaces, LeaseWatch, ServiceError, Unit};
use cara_vda5050::message::ActionStatus;
use cara_vda5050::vehicle::{ACTION_STATUSES, Condition, Guided, GuidedServer, refusal};
use clap::Parser;

/// How often the loop of the motors comes round.
const TICK: Duration = Duration::from_millis(10);

/// A simulated vehicle.
#[derive(Parser)]
struct Options {
    /// Its name.
    name: String,
    /// Its ID number.
    id: u32,
    /// The name of its gateway.
    #[arg(long, default_value = "vda5050")]
    manager: String,
    /// The gateway's ID number.
    #[arg(long, default_value_t = 1)]
    manager_id: u32,
    /// Its fleet.
    #[arg(long)]
    fleet: u32,
    /// Metres a second.
    #[arg(long, default_value_t = 1.0)]
    speed: f64,
    /// Where it stands at first.
    #[arg(long, default_value_t = 0.0)]
    x: f64,
    /// Milliseconds that an action takes.
    #[arg(long, default_value_t = 300)]
    action: u64,
}

struct Body {
    condition: Condition,
    node: String,
    target: Option<[f64; 3]>,
    speed: f64,
    most: f64,
    drive: Option<LeaseWatch>,
    action: Option<(String, Instant)>,
    handling: Option<LeaseWatch>,
    takes: Duration,
}

#[derive(Clone)]
struct Vehicle(Arc<Mutex<Body>>);

impl Vehicle {
    fn lock(&self) -> MutexGuard<'_, Body> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Guided for Vehicle {
    type Order = LeaseWatch;

    fn vda_drive(
        &mut self,
        call: &impl AnyCall<Order = LeaseWatch>,
        number: i64,
        _edge: &str,
        node: &str,
        map: &str,
        position: [f64; 3],
        given: [bool; 2],
        _deviation: [f64; 2],
        max_speed: f64,
    ) -> Result<(), ServiceError> {
        let mut body = self.lock();
        if number < body.condition.drive {
            return Err(ServiceError::Failed(refusal::OLD_NUMBER));
        }
        if !given[0] {
            return Err(ServiceError::Failed(refusal::NO_WAY));
        }
        call.commit(|| {
            if number > body.condition.drive {
                println!("drive {number} {node}");
                body.condition.has_arrived = false;
            }
            body.condition.drive = number;
            map.clone_into(&mut body.condition.map);
            node.clone_into(&mut body.node);
            body.target = Some(position);
            body.most = if max_speed > 0.0 { max_speed.min(body.speed) } else { body.speed };
            body.drive = call.order();
        })?;
        Ok(())
    }

    fn vda_act(
        &mut self,
        call: &impl AnyCall<Order = LeaseWatch>,
        number: i64,
        id: &str,
        _kind: &str,
        _details: &str,
    ) -> Result<(), ServiceError> {
        let mut body = self.lock();
        if number < body.condition.action {
            return Err(ServiceError::Failed(refusal::OLD_NUMBER));
        }
        call.commit(|| {
            if number > body.condition.action {
                println!("act {number} {id}");
                body.condition.action = number;
                body.action = Some((id.to_owned(), Instant::now()));
                body.end_with(ActionStatus::Running, "");
            }
            body.handling = call.order();
        })?;
        Ok(())
    }

    fn vda_init(&mut self, position: [f64; 3], map: &str) -> Result<(), ServiceError> {
        let mut body = self.lock();
        (body.condition.position, body.condition.map) = (position, map.to_owned());
        Ok(())
    }

    fn vda_condition(&mut self) -> Condition {
        let body = self.lock();
        let is_ordered = body.drive.as_ref().is_some_and(LeaseWatch::is_live);
        Condition { is_ordered, ..body.condition.clone() }
    }
}

impl Body {
    /// One turn of the motors' loop; the orders that are done.
    fn turn(&mut self, seconds: f64) -> Vec<LeaseWatch> {
        let mut done = Vec::new();
        let may_drive = self.drive.as_ref().is_some_and(LeaseWatch::is_live);
        let was_driving = self.condition.is_driving;
        self.condition.is_driving = may_drive && self.target.is_some() && !self.condition.has_arrived;
        if self.condition.is_driving
            && let Some([x, y, theta]) = self.target
        {
            let [at_x, at_y, _] = self.condition.position;
            let (left, step) = ((x - at_x).hypot(y - at_y), self.most * seconds);
            let part = if left <= step { 1.0 } else { step / left };
            self.condition.position = [at_x + (x - at_x) * part, at_y + (y - at_y) * part, theta];
            self.condition.driven += left.min(step);
            if part >= 1.0 {
                println!("arrived {}", self.node);
                (self.condition.has_arrived, self.condition.is_driving) = (true, false);
            }
        }
        self.condition.velocity = [if self.condition.is_driving { self.most } else { 0.0 }, 0.0, 0.0];
        if self.condition.has_arrived {
            done.extend(self.drive.take());
        } else if was_driving && !self.condition.is_driving {
            println!("stood {:.3}", self.condition.position[0]);
        }
        if let Some((id, since)) = self.action.take() {
            let may_act = self.handling.as_ref().is_some_and(LeaseWatch::is_live);
            if !may_act {
                println!("ended {id} FAILED");
                self.end_with(ActionStatus::Failed, "nobody wanted it any more");
            } else if since.elapsed() >= self.takes {
                println!("ended {id} FINISHED");
                self.end_with(ActionStatus::Finished, "done");
                done.extend(self.handling.take());
            } else {
                self.action = Some((id, since));
            }
        }
        done
    }

    fn end_with(&mut self, status: ActionStatus, result: &str) {
        let index = ACTION_STATUSES.iter().position(|word| *word == status).unwrap_or_default();
        self.condition.action_status = index as i64;
        result.clone_into(&mut self.condition.action_result);
    }
}

fn main() -> anyhow::Result<()> {
    let Options { name, id, manager, manager_id, fleet, speed, x, action } = Options::parse();
    let position = [x, 0.0, 0.0];
    let condition = Condition { position, map: "hall".into(), charge: 80.0, ..Condition::default() };
    let vehicle = Vehicle(Arc::new(Mutex::new(Body {
        condition,
        node: String::new(),
        target: None,
        speed,
        most: speed,
        drive: None,
        action: None,
        handling: None,
        takes: Duration::from_millis(action),
    })));
    vehicle.lock().end_with(ActionStatus::Finished, "");
    let builder = Unit::builder(&name, id, &manager, manager_id)?.fleet(fleet).interfaces(Interfaces::Loopback);
    let unit = builder.state(vehicle.clone()).build()?;
    // The motors' loop looks at the orders itself: nothing is left for the hooks.
    let drive = unit.my_function_list().actuator(|| ())?;
    let handling = unit.my_function_list().actuator(|| ())?;
    unit.my_function_list().serve(GuidedServer { drive, handling })?;
    unit.publish_my_function_list()?;
    unit.start()?;
    let mut last = Instant::now();
    loop {
        std::thread::sleep(TICK);
        let seconds = last.elapsed().as_secs_f64();
        last = Instant::now();
        let done = vehicle.lock().turn(seconds);
        done.iter().for_each(|order| {
            unit.end_order(order);
        });
    }
}

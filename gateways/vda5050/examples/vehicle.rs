//! A vehicle that a gateway drives: a point that moves at a constant speed, or a body of `examples/warehouse` on its floor of cells,
//! and actions that take a while.
//!
//! Its output is what really happens: `drive 4 b`, `passed b`, `arrived c`, `stood 1.25`, `act 5 pick-1`, `ended pick-1 FINISHED`;
//! of several vehicles each line begins with the vehicle's name. One of the warehouse also writes its log: `7.020000000 agv-1 enter 3,4`.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cara_apps::warehouse::{Cell, RAMP};
use cara_std::{AnyCall, Interfaces, LeaseWatch, ServiceError, Unit};
use cara_vda5050::message::{ActionStatus, Load};
use cara_vda5050::stretch::{Leg, Stretch};
use cara_vda5050::vehicle::{
    ACTION_STATUSES, Condition, Consulted, ConsultedServer, Equipment, Equipped, EquippedServer, Guided, GuidedServer,
    refusal,
};
use cara_warehouse::vehicle::Shared;
use clap::Parser;
use serde_json::Value;

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
    /// A vehicle of the warehouse, which stands in this cell at first. Nodes are the middles of cells, a metre apart; each edge leads
    /// to a cell beside.
    #[arg(long, value_parser = |text: &str| text.parse::<Cell>().map_err(|()| "write a cell as 3,4"))]
    cell: Option<Cell>,
    /// So many of them: behind agv-1 come agv-2, agv-3 …, with the ID numbers that follow.
    #[arg(long, default_value_t = 1)]
    vehicles: u32,
    /// Milliseconds that an action takes.
    #[arg(long, default_value_t = 300)]
    action: u64,
}

struct Body {
    /// Before each line of its output.
    prefix: String,
    condition: Condition,
    /// Of one of the warehouse.
    on_floor: Option<Shared>,
    /// What it was told to drive over.
    legs: Vec<Leg>,
    loads: Vec<Load>,
    speed: f64,
    drive: Option<LeaseWatch>,
    /// Whether anything may move it: an order that takes the place of another leaves no gap.
    may_drive: Option<LeaseWatch>,
    /// Its order has ended: it does not go on by what that one wanted.
    is_stopped: Arc<AtomicBool>,
    /// Its id, its type, its parameters, and since when.
    action: Option<(String, String, Value, Instant)>,
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
        count: i64,
        edges: &str,
        nodes: &str,
        map: &str,
        positions: [f64; 24],
        given: [bool; 16],
        deviations: [f64; 16],
        max_speeds: [f64; 8],
    ) -> Result<(), ServiceError> {
        let mut body = self.lock();
        let stretch = Stretch { number, count, edges, nodes, positions, given, deviations, max_speeds };
        let legs = body.judge(&stretch)?;
        call.commit(|| {
            map.clone_into(&mut body.condition.map);
            body.legs = legs;
            if body.condition.drive < number || body.condition.has_arrived {
                body.next_leg();
            }
            body.drive = call.order();
            body.is_stopped.store(false, Ordering::SeqCst);
        })?;
        Ok(())
    }

    fn vda_act(
        &mut self,
        call: &impl AnyCall<Order = LeaseWatch>,
        number: i64,
        id: &str,
        kind: &str,
        details: &str,
    ) -> Result<(), ServiceError> {
        let mut body = self.lock();
        if number < body.condition.action {
            return Err(ServiceError::Failed(refusal::OLD_NUMBER));
        }
        call.commit(|| {
            if number > body.condition.action {
                println!("{}act {number} {id}", body.prefix);
                body.condition.action = number;
                let details: Value = serde_json::from_str(details).unwrap_or_default();
                body.action = Some((id.to_owned(), kind.to_owned(), details, Instant::now()));
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
        let is_ordered = body.may_drive();
        Condition { is_ordered, ..body.condition.clone() }
    }
}

impl Consulted for Vehicle {
    fn vda_can_drive(
        &mut self,
        number: i64,
        count: i64,
        edges: &str,
        nodes: &str,
        _map: &str,
        positions: [f64; 24],
        given: [bool; 16],
        deviations: [f64; 16],
        max_speeds: [f64; 8],
    ) -> Result<(), ServiceError> {
        let stretch = Stretch { number, count, edges, nodes, positions, given, deviations, max_speeds };
        self.lock().judge(&stretch).map(drop)
    }
}

impl Equipped for Vehicle {
    fn vda_equipment(&mut self) -> Equipment {
        Equipment { voltage: 48.0, ..Equipment::carrying(&self.lock().loads) }
    }
}

impl Body {
    /// One turn of the motors' loop; the orders that are done.
    fn turn(&mut self, seconds: f64) -> Vec<LeaseWatch> {
        let mut done = Vec::new();
        let may_drive = self.may_drive();
        let was_driving = self.condition.is_driving;
        let leg = self.leg().filter(|_| may_drive && !self.condition.has_arrived).cloned();
        let (speed, is_there) = self.advance(leg.as_ref(), seconds);
        self.condition.is_driving = leg.is_some() || speed > 0.0;
        if let Some(leg) = leg.filter(|_| is_there) {
            let is_last = self.legs.last().is_some_and(|last| last.number == leg.number);
            println!("{}{} {}", self.prefix, if is_last { "arrived" } else { "passed" }, leg.node);
            self.next_leg();
            self.condition.is_driving = !self.condition.has_arrived;
        }
        self.condition.velocity = [if self.condition.is_driving { speed } else { 0.0 }, 0.0, 0.0];
        if self.condition.has_arrived {
            done.extend(self.drive.take());
        } else if was_driving && !self.condition.is_driving {
            println!("{}stood {:.3}", self.prefix, self.condition.position[0]);
        }
        if let Some((id, kind, details, since)) = self.action.take() {
            let may_act = self.handling.as_ref().is_some_and(LeaseWatch::is_live);
            if !may_act {
                println!("{}ended {id} FAILED", self.prefix);
                self.end_with(ActionStatus::Failed, "nobody wanted it any more");
            } else if since.elapsed() >= self.takes {
                println!("{}ended {id} FINISHED", self.prefix);
                self.handled(&kind, &details);
                self.end_with(ActionStatus::Finished, "done");
                done.extend(self.handling.take());
            } else {
                self.action = Some((id, kind, details, since));
            }
        }
        done
    }

    /// Moves to the end of a leg, or down to a stop: how fast, and whether it is there.
    fn advance(&mut self, leg: Option<&Leg>, seconds: f64) -> (f64, bool) {
        let [at_x, at_y, at_theta] = self.condition.position;
        let theta = leg.and_then(|leg| leg.theta).unwrap_or(at_theta);
        let (to, speed, is_there) = if let Some(vehicle) = &self.on_floor {
            let mut vehicle = vehicle.lock();
            let before = vehicle.agv.body.at();
            let is_there = vehicle.agv.body.step(Duration::from_secs_f64(seconds), leg.is_some(), false);
            if is_there {
                vehicle.note(format_args!("leave {before}"));
            }
            vehicle.log.drain(..).for_each(|line| println!("{line}"));
            let [x, y] = vehicle.agv.body.position();
            ([x, y], (x - at_x).hypot(y - at_y) / seconds, is_there)
        } else if let Some((leg, [x, y])) = leg.and_then(|leg| Some((leg, leg.position?))) {
            let speed = leg.max_speed.unwrap_or(self.speed).min(self.speed);
            let (left, step) = ((x - at_x).hypot(y - at_y), speed * seconds);
            let part = if left <= step { 1.0 } else { step / left };
            ([at_x + (x - at_x) * part, at_y + (y - at_y) * part], speed, part >= 1.0)
        } else {
            ([at_x, at_y], 0.0, false)
        };
        self.condition.position = [to[0], to[1], theta];
        self.condition.driven += (to[0] - at_x).hypot(to[1] - at_y);
        (speed, is_there)
    }

    /// The edges of a stretch that it can drive.
    fn judge(&self, stretch: &Stretch<'_>) -> Result<Vec<Leg>, ServiceError> {
        let legs = stretch.legs().filter(|legs| legs.iter().all(|leg| leg.position.is_some()));
        let Some(legs) = legs else { return Err(ServiceError::Failed(refusal::NO_WAY)) };
        if stretch.number + stretch.count <= self.condition.drive {
            return Err(ServiceError::Failed(refusal::OLD_NUMBER));
        }
        if self.can_drive(&legs) { Ok(legs) } else { Err(ServiceError::Failed(refusal::NO_WAY)) }
    }

    /// Whether it gets there: on a floor from cell to cell.
    fn can_drive(&self, legs: &[Leg]) -> bool {
        let Some(vehicle) = &self.on_floor else { return true };
        let body = &vehicle.lock().agv.body;
        let goes_on = !self.condition.has_arrived && legs.iter().any(|leg| leg.number == self.condition.drive);
        let mut at = goes_on.then(|| body.next());
        let mut new = legs.iter().filter(|leg| leg.number > self.condition.drive).map(cell);
        new.all(|cell| {
            let before = at;
            at = cell;
            cell.is_some_and(|cell| before.map_or(body.can_enter(cell), |before| before.distance(cell) == 1))
        })
    }

    fn may_drive(&self) -> bool {
        self.may_drive.as_ref().is_some_and(LeaseWatch::is_live) && !self.is_stopped.load(Ordering::SeqCst)
    }

    fn leg(&self) -> Option<&Leg> {
        self.legs.iter().find(|leg| leg.number == self.condition.drive)
    }

    /// Begins the next edge, if there is one.
    fn next_leg(&mut self) {
        let next = self.legs.iter().find(|leg| leg.number > self.condition.drive);
        self.condition.has_arrived = next.is_none();
        if let Some(next @ Leg { number, node, .. }) = next {
            println!("{}drive {number} {node}", self.prefix);
            self.condition.drive = *number;
            if let (Some(vehicle), Some(cell)) = (&self.on_floor, cell(next)) {
                let mut vehicle = vehicle.lock();
                if vehicle.agv.body.next() != cell {
                    vehicle.agv.body.enter(cell);
                    vehicle.note(format_args!("enter {cell}"));
                }
            }
        }
    }

    /// What has become of its loads.
    fn handled(&mut self, kind: &str, details: &Value) {
        let text = |key: &str| details[key].as_str().map(str::to_owned);
        match kind {
            "pick" => {
                self.loads.push(Load { load_id: text("loadId"), load_type: text("loadType"), ..Load::default() });
            }
            "drop" => drop(self.loads.pop()),
            _ => {}
        }
    }

    fn end_with(&mut self, status: ActionStatus, result: &str) {
        let index = ACTION_STATUSES.iter().position(|word| *word == status).unwrap_or_default();
        self.condition.action_status = index as i64;
        result.clone_into(&mut self.condition.action_result);
    }
}

/// The cell at the end of a leg.
fn cell(leg: &Leg) -> Option<Cell> {
    Cell::of_numbers(leg.position?.map(|metres| metres.round() as i64))
}

fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    // agv-1 is followed by agv-2.
    let prefix = options.name.trim_end_matches(|letter: char| letter.is_ascii_digit());
    let first: u32 = options.name[prefix.len()..].parse().unwrap_or_default();
    let mut all = vec![start(&options, &options.name, options.id)?];
    for more in 1..options.vehicles {
        all.push(start(&options, &format!("{prefix}{}", first + more), options.id + more)?);
    }
    let mut last = Instant::now();
    loop {
        std::thread::sleep(TICK);
        let seconds = last.elapsed().as_secs_f64();
        last = Instant::now();
        for (vehicle, unit) in &all {
            let done = vehicle.lock().turn(seconds);
            done.iter().for_each(|order| {
                unit.end_order(order);
            });
        }
    }
}

fn start(options: &Options, name: &str, id: u32) -> anyhow::Result<(Vehicle, Unit<Vehicle>)> {
    let Options { manager, manager_id, fleet, speed, x, action, vehicles, .. } = options;
    let position = options.cell.map_or([*x, 0.0, 0.0], |cell| [f64::from(cell.x), f64::from(cell.y), 0.0]);
    let condition = Condition { position, map: "hall".into(), charge: 80.0, ..Condition::default() };
    let prefix = if *vehicles > 1 { format!("{name} ") } else { String::new() };
    let vehicle = Vehicle(Arc::new(Mutex::new(Body {
        prefix,
        on_floor: options.cell.map(|cell| Shared::new(name.to_owned(), cell, 80.0)),
        condition,
        legs: Vec::new(),
        loads: Vec::new(),
        speed: *speed,
        drive: None,
        may_drive: None,
        is_stopped: Arc::default(),
        action: None,
        handling: None,
        takes: Duration::from_millis(*action),
    })));
    vehicle.lock().end_with(ActionStatus::Finished, "");
    let builder = Unit::builder(name, id, manager, *manager_id)?.fleet(*fleet).interfaces(Interfaces::Loopback);
    let unit = builder.state(vehicle.clone()).build()?;
    let is_stopped = vehicle.lock().is_stopped.clone();
    let drive = unit.my_function_list().actuator(move || is_stopped.store(true, Ordering::SeqCst))?;
    let drive = if options.cell.is_some() { drive.ramp(RAMP) } else { drive };
    vehicle.lock().may_drive = Some(drive.watch());
    // What is handled looks at its order itself: nothing is left for the hook.
    let handling = unit.my_function_list().actuator(|| ())?;
    unit.my_function_list().serve(GuidedServer { drive, handling })?;
    unit.my_function_list().serve(ConsultedServer)?;
    unit.my_function_list().serve(EquippedServer)?;
    unit.publish_my_function_list()?;
    unit.start()?;
    Ok((vehicle, unit))
}

//! Two hundred vehicles that publish ten values a second each, all read by one manager: what its calls notice of it.

use cara_core::config::Constraints;
use cara_core::distribution::parameters::Parameters;
use cara_core::host::connections::LinkCounter;
use cara_core::time::Duration;
use cara_sim::{Path, Service, UnitHandle, World};

const VEHICLES: u32 = 200;
/// Between two values of a vehicle.
const PAUSE: Duration = Duration::from_millis(100);
/// Values of each vehicle.
const VALUES: u64 = 100;
const FUNCTIONS: usize = 4;

fn pose(x: f64) -> Parameters {
    let mut values = Parameters::new();
    values.add_float("position", 2).expect("there is room");
    values.set_value("position", [x, -x]).expect("it is declared so");
    values
}

fn start_vehicle(world: &World, id: u32) -> UnitHandle {
    let program = move |unit: &UnitHandle| {
        let list = unit.my_function_list();
        list.add_service("touch()", Service::new(|_, _| Ok(()))).expect("the list is empty");
        unit.add_stream("pose(position: float[2])", Duration::ZERO).expect("there is room");
        unit.publish_my_function_list().expect("it runs");
    };
    world.s_unit(&format!("agv-{id}"), id).joins("depot", 1).functions(FUNCTIONS).program(program).start()
}

/// The longest but one percent of calls that go round the fleet, one each 5 ms.
fn p99(world: &mut World, manager: &UnitHandle, calls: u32) -> Duration {
    let mut times = Vec::new();
    for call in 0..calls {
        let (caller, peer) = (manager.clone(), format!("agv-{}", 10 + call % VEHICLES));
        let began = world.now();
        let outcome =
            world.block_on(async move { caller.block_request(&*peer, "touch", &mut Parameters::new()).await });
        assert_eq!(outcome, Ok(()));
        times.push(world.now().since(began));
        world.run_for(Duration::from_millis(5));
    }
    times.sort();
    times[times.len() * 99 / 100]
}

#[test]
fn streams_of_a_fleet_hurt_no_call() {
    let mut world = World::new(1);
    world.network(|network| {
        let path = Path::LAN.delay(Duration::from_millis(1)).jitter(Duration::from_millis(1));
        network.set_fault_profile(path, Duration::from_secs(3_600));
    });
    let constraints = Constraints { maximum_nodes: VEHICLES as u16, ..Constraints::M_UNIT };
    let manager = world.m_unit("depot", 1).constraints(constraints).functions(FUNCTIONS).start();
    let vehicles: Vec<_> = (10..10 + VEHICLES).map(|id| start_vehicle(&world, id)).collect();
    while manager.nodes_offering("touch").len() < VEHICLES as usize {
        world.run_for(Duration::from_millis(50));
        assert!(world.now() < cara_core::time::Instant::from_micros(60_000_000), "not all have joined");
    }
    let idle = p99(&mut world, &manager, 1_000);
    for vehicle in &vehicles {
        manager.subscribe(vehicle, "pose", Duration::ZERO).expect("it is connected");
        let (unit, id) = (vehicle.clone(), vehicle.identity().id());
        // Not all at the same instant.
        vehicle.spawn(async move {
            unit.sleep(PAUSE.times(u64::from(id % 20)).divided_by(20)).await;
            for value in 0..VALUES {
                unit.put("pose", &pose(value as f64)).expect("it is declared so");
                unit.sleep(PAUSE).await;
            }
        });
    }
    let loaded = p99(&mut world, &manager, 1_000);
    world.run_for(PAUSE.times(VALUES));
    let counted: u64 = vehicles.iter().map(|vehicle| manager.samples_counted(vehicle, "pose")).sum();
    println!("{counted} values; p99 of calls {} us idle, {} us beside them", idle.as_micros(), loaded.as_micros());
    assert!(loaded <= idle + Duration::from_millis(2), "{loaded:?} {idle:?}");
    assert_eq!(counted, u64::from(VEHICLES) * VALUES, "every value was due, and none was in the way of another");
    assert_eq!(manager.counted(LinkCounter::SamplesDropped), 0);
    for vehicle in &vehicles {
        let samples = manager.samples(vehicle, "pose");
        let last = samples.last().expect("values have come");
        assert_eq!(last.values.variable::<[f64; 2]>("position"), Ok([99.0, -99.0]));
        // The way takes a millisecond at least, and what bounds the age three at most.
        let in_bounds = |age: Duration| age >= Duration::from_millis(1) && age <= Duration::from_millis(20);
        assert!(samples.iter().all(|sample| in_bounds(sample.age)), "{:?}", last.age);
    }
}

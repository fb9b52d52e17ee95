use cara_core::Variables;

#[derive(Variables)]
struct Note {
    #[size(64)]
    text: &'static str,
}

fn main() {}

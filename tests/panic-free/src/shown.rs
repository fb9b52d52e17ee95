//! What can be formatted, formatted.

use cara_core::distribution::function::Definition;
use cara_core::distribution::function_list::{FunctionList, TheirFunctionList};
use cara_core::distribution::identity::Identity;
use cara_core::error::Error;
use cara_core::storage::Lent;

use crate::linkage::{show, unknown};

entry!(shown_errors, {
    show(unknown::<Error>());
});

entry!(shown_definitions, {
    show(unknown::<Definition>());
});

entry!(shown_lists, {
    show(unknown::<FunctionList<Lent, u32>>().show_functions());
    show(unknown::<TheirFunctionList<Lent>>().show_functions());
});

entry!(shown_identities, {
    show(unknown::<Identity>());
});

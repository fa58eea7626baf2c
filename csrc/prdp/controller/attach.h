#pragma once
#include <vector>

#include "prdp/controller/controller.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

/// Gives a stepper what the coming interval's solves get.
void set_budget(Stepper& stepper, const Budget& budget);

/// What the last solves of the steppers were like, of several the worst; without an error, which only the
/// training knows.
Solves last_solves(const std::vector<Stepper>& steppers);

}  // namespace prdp

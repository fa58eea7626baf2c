#pragma once
#include <concepts>
#include <vector>

#include "prdp/controller/controller.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

/// Sets K and the tolerances of a stepper for the next interval. What the budget does not give stays as it is.
void set_budget(StepperBase& stepper, const Budget& budget);

/// The outcome of the last solves of the steppers; of several steppers, the worst. Its `error` is empty, because only
/// the training knows it.
Solves last_solves(const std::vector<const StepperBase*>& steppers);
/// The same for steppers of one class.
template <std::derived_from<StepperBase> Kind>
Solves last_solves(const std::vector<Kind>& steppers) {
  std::vector<const StepperBase*> each;
  for (const auto& stepper : steppers) each.push_back(&stepper);
  return last_solves(each);
}

}  // namespace prdp

#pragma once
#include <concepts>
#include <vector>

#include "prdp/controller/controller.h"
#include "prdp/steppers/solving.h"

namespace prdp {

/// Sets K and the tolerances of a stepper for the next interval. What the budget does not give stays as it is.
void set_budget(Solving& stepper, const Budget& budget);

/// The outcome of the last solves of the steppers; of several steppers, the worst. Its `error` is empty, because only
/// the training knows it.
Solves last_solves(const std::vector<const Solving*>& steppers);
/// The same for steppers of one class.
template <std::derived_from<Solving> Kind>
Solves last_solves(const std::vector<Kind>& steppers) {
  std::vector<const Solving*> each;
  for (const auto& stepper : steppers) each.push_back(&stepper);
  return last_solves(each);
}

}  // namespace prdp

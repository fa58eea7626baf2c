#pragma once
#include <concepts>
#include <vector>

#include "prdp/controller/controller.h"
#include "prdp/steppers/solving.h"

namespace prdp {

/// Gives a stepper what the coming interval's solves get.
void set_budget(Solving& stepper, const Budget& budget);

/// What the last solves of the steppers were like, of several the worst; without an error, which only the
/// training knows.
Solves last_solves(const std::vector<const Solving*>& steppers);
/// The same, of steppers of one kind.
template <std::derived_from<Solving> Kind>
Solves last_solves(const std::vector<Kind>& steppers) {
  std::vector<const Solving*> each;
  for (const auto& stepper : steppers) each.push_back(&stepper);
  return last_solves(each);
}

}  // namespace prdp

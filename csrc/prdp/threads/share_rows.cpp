#include "prdp/threads/share_rows.h"

namespace prdp::share_rows {

namespace {
thread_local bool wanted_here = false;
}

bool wanted() { return wanted_here; }

Scope::Scope(bool wanted) : before_(std::exchange(wanted_here, wanted)) {}
Scope::~Scope() { wanted_here = before_; }

}  // namespace prdp::share_rows

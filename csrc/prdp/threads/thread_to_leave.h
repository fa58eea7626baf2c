#pragma once
#include <chrono>
#include <future>
#include <memory>
#include <thread>
#include <utility>

#include "prdp/threads/interruption.h"

namespace prdp::interruption {

/// body(), which cannot be interrupted; if `long_running`, on a thread that is left behind when this one is
/// interrupted. What the body refers to must live as long as it runs.
template <class Body>
auto in_a_thread_to_leave(bool long_running, Body body) {
  if (!long_running) return body();
  std::packaged_task<decltype(body())()> task(std::move(body));
  auto result = task.get_future();
  std::thread(std::move(task)).detach();
  while (result.wait_for(std::chrono::milliseconds(50)) != std::future_status::ready) Watch::local().look();
  return result.get();
}

}  // namespace prdp::interruption

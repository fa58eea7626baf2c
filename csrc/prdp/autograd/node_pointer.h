#pragma once
#include <torch/csrc/autograd/function.h>
#include <torch/headeronly/version.h>

#include <memory>
#include <utility>

namespace prdp {

/// What holds a node of autograd, and how one is made. From torch 2.13 on nodes count their references themselves.
#if TORCH_VERSION_MAJOR == 2 && TORCH_VERSION_MINOR < 13
template <class Node>
using NodePointer = std::shared_ptr<Node>;
template <class Node, class... Arguments>
NodePointer<Node> make_node(Arguments&&... arguments) {  // a long graph is not taken down by recursion
  return {new Node(std::forward<Arguments>(arguments)...), torch::autograd::deleteNode};
}
#else
template <class Node>
using NodePointer = c10::intrusive_ptr<Node>;
template <class Node, class... Arguments>
NodePointer<Node> make_node(Arguments&&... arguments) {
  return c10::make_intrusive<Node>(std::forward<Arguments>(arguments)...);
}
#endif

}  // namespace prdp

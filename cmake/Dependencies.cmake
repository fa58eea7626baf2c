# Where the libraries come from. Torch is the one of the Python that runs the build; header-only
# libraries come from the system (Debian: libeigen3-dev libgtest-dev libtomlplusplus-dev
# nlohmann-json3-dev libcli11-dev), Eigen also from pip's cmeel-eigen.
find_package(Python 3.11 REQUIRED COMPONENTS Interpreter)

if(NOT Torch_DIR)
  execute_process(
    COMMAND ${Python_EXECUTABLE} -c "import torch; print(torch.utils.cmake_prefix_path)"
    OUTPUT_VARIABLE torch_prefix OUTPUT_STRIP_TRAILING_WHITESPACE
    ERROR_QUIET RESULT_VARIABLE no_torch)
  if(no_torch)
    message(FATAL_ERROR "prdp: ${Python_EXECUTABLE} has no torch; pip install torch==2.13.0 first")
  endif()
  list(APPEND CMAKE_PREFIX_PATH ${torch_prefix})
endif()
include(${CMAKE_CURRENT_LIST_DIR}/prdpTorch.cmake)
if(prdp_torch_problem)
  message(FATAL_ERROR "prdp: ${prdp_torch_problem}")
endif()

execute_process(
  COMMAND ${Python_EXECUTABLE} -c "import pathlib, cmeel; print(pathlib.Path(cmeel.__file__).parent.parent / 'cmeel.prefix')"
  OUTPUT_VARIABLE cmeel_prefix OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
if(cmeel_prefix)
  list(APPEND CMAKE_PREFIX_PATH ${cmeel_prefix})
endif()

find_package(Eigen3 3.4 QUIET NO_MODULE)
if(NOT Eigen3_FOUND)  # without its files for CMake, as in a folder of headers; this header came with Eigen 3.4
  find_path(eigen_INCLUDE_DIR Eigen/src/Core/StlIterators.h PATH_SUFFIXES eigen3)
  if(NOT eigen_INCLUDE_DIR)
    message(FATAL_ERROR "prdp: Eigen was not found; apt-get install libeigen3-dev or pip install cmeel-eigen")
  endif()
  add_library(Eigen3::Eigen INTERFACE IMPORTED)
  target_include_directories(Eigen3::Eigen INTERFACE ${eigen_INCLUDE_DIR})
endif()

# A header-only library as an imported target. The part of the project that needs it is left out where it is AUTO and
# the header is not found; where the part was asked for, one sentence says what to install.
function(prdp_header_library part name header debian)
  find_path(${name}_INCLUDE_DIR ${header})
  if(${name}_INCLUDE_DIR)
    add_library(prdp_${name} INTERFACE)
    target_include_directories(prdp_${name} SYSTEM INTERFACE ${${name}_INCLUDE_DIR})
  elseif(${part} STREQUAL "AUTO")
    message(STATUS "prdp: without ${part}, as <${header}> was not found; apt-get install ${debian}")
    set(${part} OFF PARENT_SCOPE)
  elseif(${part})
    message(FATAL_ERROR "prdp: <${header}> was not found; apt-get install ${debian}, or configure with -D${part}=OFF")
  endif()
endfunction()
prdp_header_library(PRDP_EXPERIMENTS tomlplusplus toml++/toml.h libtomlplusplus-dev)
prdp_header_library(PRDP_EXPERIMENTS json nlohmann/json.hpp nlohmann-json3-dev)
prdp_header_library(PRDP_TRAINER cli11 CLI/CLI.hpp libcli11-dev)
if(NOT PRDP_EXPERIMENTS)
  set(PRDP_TRAINER OFF)
endif()

// A C++17 client of vlagents_ray's policy server: this header is all that a program includes.
#pragma once

#include "vlagents_ray/chunk_player.hpp"
#include "vlagents_ray/client.hpp"
#include "vlagents_ray/error.hpp"
#include "vlagents_ray/types.hpp"

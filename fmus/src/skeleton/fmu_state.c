/* SPDX-License-Identifier: Apache-2.0
 *
 * The FMU state: one block of memory that holds the skeleton's progress, the model's state and the model's
 * growing memory. In memory and serialized it looks the same. Bytes are for the same FMU on the same
 * platform.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "fmu_guid.h"
#include "instance.h"

#define GUID_SIZE 48

typedef struct {
    char guid[GUID_SIZE];
    uint64_t size; /* of the whole block in bytes, this header included */
    uint64_t memory_size;
    uint64_t checksum; /* of a serialized block with this field 0; 0 while in memory */
    Progress progress;
} Header;

typedef char guid_fits[sizeof FMU_GUID <= GUID_SIZE ? 1 : -1];

/* FNV-1a, 64 bits: a damaged block must not become indices into memory. */
static uint64_t checksum_of(const char *bytes, size_t size)
{
    uint64_t hash = 14695981039346656037u;
    for (size_t i = 0; i < size; ++i) hash = (hash ^ (unsigned char)bytes[i]) * 1099511628211u;
    return hash;
}

static char *state_in(Header *block) { return (char *)(block + 1); }

static char *memory_in(Header *block) { return state_in(block) + model.state_size; }

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    Instance *instance = called(c, "fmi2GetFMUstate", ANY_MODE);
    size_t size;
    Header *block;

    if (instance == NULL) return fmi2Error;
    size = sizeof *block + model.state_size + instance->memory_size;
    block = calloc(1, size);
    if (block == NULL) return report(instance, fmi2Error, "fmi2GetFMUstate: out of memory");
    strcpy(block->guid, FMU_GUID);
    block->size = size;
    block->memory_size = instance->memory_size;
    block->progress = instance->progress;
    memcpy(state_in(block), instance->state, model.state_size);
    if (instance->memory_size > 0) memcpy(memory_in(block), instance->memory, instance->memory_size);
    free(*FMUstate);
    *FMUstate = block;
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate)
{
    Instance *instance = called(c, "fmi2SetFMUstate", ANY_MODE);
    Header *block = FMUstate;

    if (instance == NULL) return fmi2Error;
    if (block == NULL) return report(instance, fmi2Error, "fmi2SetFMUstate: there is no FMU state");
    if (!resize_instance_memory(instance, (size_t)block->memory_size))
        return report(instance, fmi2Error, "fmi2SetFMUstate: out of memory");
    instance->progress = block->progress;
    memcpy(instance->state, state_in(block), model.state_size);
    if (instance->memory_size > 0) memcpy(instance->memory, memory_in(block), instance->memory_size);
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    Instance *instance = called(c, "fmi2FreeFMUstate", ANY_MODE);

    if (instance == NULL) return fmi2Error;
    if (FMUstate != NULL) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size)
{
    Instance *instance = called(c, "fmi2SerializedFMUstateSize", ANY_MODE);
    const Header *block = FMUstate;

    if (instance == NULL) return fmi2Error;
    if (block == NULL)
        return report(instance, fmi2Error, "fmi2SerializedFMUstateSize: there is no FMU state");
    *size = (size_t)block->size;
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[],
                                 size_t size)
{
    Instance *instance = called(c, "fmi2SerializeFMUstate", ANY_MODE);
    const Header *block = FMUstate;
    Header header;

    if (instance == NULL) return fmi2Error;
    if (block == NULL) return report(instance, fmi2Error, "fmi2SerializeFMUstate: there is no FMU state");
    if (size < block->size)
        return report(instance, fmi2Error,
                      "fmi2SerializeFMUstate: room for %zu bytes but the FMU state has %zu", size,
                      (size_t)block->size);
    memcpy(serializedState, block, (size_t)block->size);
    memcpy(&header, serializedState, sizeof header);
    header.checksum = checksum_of(serializedState, (size_t)block->size);
    memcpy(serializedState, &header, sizeof header);
    return fmi2OK;
}

/* Whether the block, which still carries its checksum, is a whole and undamaged state of this very FMU. */
static bool is_sound(Header *block, size_t size)
{
    uint64_t checksum = block->checksum;

    block->checksum = 0;
    return block->size == size && memcmp(block->guid, FMU_GUID, sizeof FMU_GUID) == 0 &&
           block->memory_size == size - sizeof *block - model.state_size &&
           checksum == checksum_of((const char *)block, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate)
{
    Instance *instance = called(c, "fmi2DeSerializeFMUstate", ANY_MODE);
    Header *block;

    if (instance == NULL) return fmi2Error;
    if (size < sizeof *block + model.state_size)
        return report(instance, fmi2Error, "fmi2DeSerializeFMUstate: %zu bytes are too few for an FMU state",
                      size);
    block = malloc(size);
    if (block == NULL) return report(instance, fmi2Error, "fmi2DeSerializeFMUstate: out of memory");
    memcpy(block, serializedState, size);
    if (!is_sound(block, size)) {
        free(block);
        return report(instance, fmi2Error,
                      "fmi2DeSerializeFMUstate: the bytes are damaged or come from another FMU");
    }
    free(*FMUstate);
    *FMUstate = block;
    return fmi2OK;
}

"""A stranger with nothing but `grpcio` and reflection: lists the services and calls `Step`.

Usage: reflection.py HOST:PORT MISSION.json
"""

import json
import sys

import grpc
from google.protobuf import json_format
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)

EXPECTED_SERVICES = {
    "vbar.v1.GuidanceService",
    "google.longrunning.Operations",
    "grpc.health.v1.Health",
}


def step_request(mission):
    """The first step of a mission that starts at a fixed state."""
    start = mission["simulation"]["initial_state"]["fixed"]
    return {
        "problem": mission["problem"],
        "measurement": {
            "relative": {
                "frame": "FRAME_RTN",
                "positionM": start["position_m"],
                "velocityMS": start["velocity_m_s"],
            },
            "elapsedS": 0.0,
        },
    }


def main(address, mission_path):
    with open(mission_path, encoding="utf-8") as file:
        mission = json.load(file)
    with grpc.insecure_channel(address) as channel:
        database = ProtoReflectionDescriptorDatabase(channel)
        services = set(database.get_services())
        missing = EXPECTED_SERVICES - services
        assert not missing, f"reflection does not list {missing}, only {services}"
        print("services:", ", ".join(sorted(services)))

        service = DescriptorPool(database).FindServiceByName("vbar.v1.GuidanceService")
        method = service.FindMethodByName("Step")
        request_class = GetMessageClass(method.input_type)
        response_class = GetMessageClass(method.output_type)
        step = channel.unary_unary(
            f"/{service.full_name}/{method.name}",
            request_serializer=request_class.SerializeToString,
            response_deserializer=response_class.FromString,
        )
        request = json_format.ParseDict(step_request(mission), request_class())
        answer = step(request, timeout=30)
        assert answer.WhichOneof("verdict") == "command", answer
        assert answer.certificate.passed, answer.certificate
        acceleration = list(answer.command.acceleration_m_s2)
        assert len(acceleration) == 3, acceleration
        print("Step answers", acceleration, "m/s2, certificate passed")

        try:
            step(request_class(), timeout=30)
        except grpc.RpcError as error:
            assert error.code() == grpc.StatusCode.INVALID_ARGUMENT, error
            print("an empty Step is refused:", error.details())
        else:
            raise AssertionError("an empty Step was answered")


if __name__ == "__main__":
    main(*sys.argv[1:])

#version 430 core
// Colours one part: [Tsai2006] eq. (22) with the sum over weights already taken on the CPU.
// phi' is evaluated in each corner's own frame and the three colours are mixed.  Filtering is done
// by hand: hardware filters with 8-bit weights, and the numpy decode must agree.
layout(std430, binding = 0) readonly buffer Faces { int faces[]; };
layout(std430, binding = 1) readonly buffer Positions { float positions[]; };
layout(std430, binding = 2) readonly buffer Normals { float normals[]; };
layout(std430, binding = 3) readonly buffer Frames { float frames[]; };
layout(std430, binding = 4) readonly buffer Radiance { float radiance[]; };
layout(std430, binding = 5) readonly buffer Uv { float uv[]; };
layout(std430, binding = 6) readonly buffer Colours { float vertex_colours[]; };

uniform sampler2D visibility;
uniform sampler2DArray view_texture;
uniform sampler2D albedo_texture;
uniform ivec2 part_range;
uniform int n_view;
uniform bool has_view_texture;
uniform bool has_albedo_texture;
uniform bool has_vertex_colours;
uniform vec3 albedo;
uniform vec3 camera_right;
uniform vec3 camera_up;
uniform vec3 camera_back;
uniform vec2 half_extent;
uniform vec2 size;

layout(location = 0) out vec4 colour;

const float TINY = 1e-20;

vec3 position_of(int v) { return vec3(positions[3 * v], positions[3 * v + 1], positions[3 * v + 2]); }
vec3 normal_of(int v) { return vec3(normals[3 * v], normals[3 * v + 1], normals[3 * v + 2]); }
vec2 uv_of(int v) { return vec2(uv[2 * v], uv[2 * v + 1]); }

vec3 vertex_colour_of(int v) {
    int at = 3 * (v - part_range.x);
    return vec3(vertex_colours[at], vertex_colours[at + 1], vertex_colours[at + 2]);
}

vec3 row(int frame, int i) {
    int at = 9 * frame + 3 * i;
    return vec3(frames[at], frames[at + 1], frames[at + 2]);
}

vec3 column(int local, int r) {
    int at = 3 * (local * n_view + r);
    return vec3(radiance[at], radiance[at + 1], radiance[at + 2]);
}

// The map of prtbake_storage.decode.view_map.
vec2 hemi_octahedral(vec3 d) {
    float norm = max(abs(d.x) + abs(d.y) + max(d.z, 0.0), TINY);
    vec2 p = d.xy / norm;
    return vec2(p.x + p.y + 1.0, p.x - p.y + 1.0) * 0.5;
}

vec3 corner_colour(int vertex, vec3 wo) {
    int local = vertex - part_range.x;
    if (!has_view_texture) {
        return column(local, 0);
    }
    vec3 wo_local = vec3(dot(row(local, 0), wo), dot(row(local, 1), wo), dot(row(local, 2), wo));
    ivec2 last = textureSize(view_texture, 0).xy - 1;
    vec2 place = clamp(hemi_octahedral(wo_local) * vec2(last + 1) - 0.5, vec2(0.0), vec2(last));
    ivec2 a = ivec2(floor(place));
    ivec2 b = min(a + 1, last);
    vec2 t = place - vec2(a);
    vec3 sum = vec3(0.0);
    for (int r = 0; r < n_view; ++r) {
        vec3 upper = mix(texelFetch(view_texture, ivec3(a.x, a.y, r), 0).rgb,
                         texelFetch(view_texture, ivec3(b.x, a.y, r), 0).rgb, t.x);
        vec3 lower = mix(texelFetch(view_texture, ivec3(a.x, b.y, r), 0).rgb,
                         texelFetch(view_texture, ivec3(b.x, b.y, r), 0).rgb, t.x);
        sum += mix(upper, lower, t.y) * column(local, r);
    }
    return sum;
}

// Repeated outside the unit square; row 0 lies at v = 1.
vec3 albedo_at(vec2 at) {
    ivec2 extent = textureSize(albedo_texture, 0);
    vec2 place = vec2(fract(at.x), fract(1.0 - at.y)) * vec2(extent) - 0.5;
    vec2 t = fract(place);
    ivec2 a = (ivec2(floor(place)) + extent) % extent;
    ivec2 b = (a + 1) % extent;
    vec3 upper = mix(texelFetch(albedo_texture, ivec2(a.x, a.y), 0).rgb,
                     texelFetch(albedo_texture, ivec2(b.x, a.y), 0).rgb, t.x);
    vec3 lower = mix(texelFetch(albedo_texture, ivec2(a.x, b.y), 0).rgb,
                     texelFetch(albedo_texture, ivec2(b.x, b.y), 0).rgb, t.x);
    return mix(upper, lower, t.y);
}

void main() {
    vec4 seen = texelFetch(visibility, ivec2(gl_FragCoord.xy), 0);
    int triangle = int(seen.x) - 1;
    if (triangle < 0) {
        discard;
    }
    ivec3 corners = ivec3(faces[3 * triangle], faces[3 * triangle + 1], faces[3 * triangle + 2]);
    if (corners.x < part_range.x || corners.x >= part_range.y) {
        discard;
    }
    vec2 at = (2.0 * gl_FragCoord.xy / size - 1.0) * half_extent;
    vec3 wo = normalize(camera_back - at.x * camera_right - at.y * camera_up);

    // black from behind, whichever way the triangle is wound
    vec3 origin = position_of(corners.x);
    vec3 normal = cross(position_of(corners.y) - origin, position_of(corners.z) - origin);
    vec3 shading = normal_of(corners.x) + normal_of(corners.y) + normal_of(corners.z);
    if ((dot(normal, shading) >= 0.0) != (dot(normal, wo) >= 0.0)) {
        colour = vec4(0.0, 0.0, 0.0, 1.0);
        return;
    }
    vec3 mixed = seen.y * corner_colour(corners.x, wo) + seen.z * corner_colour(corners.y, wo)
               + seen.w * corner_colour(corners.z, wo);
    vec3 tint = albedo;
    if (has_albedo_texture) {
        tint *= albedo_at(seen.y * uv_of(corners.x) + seen.z * uv_of(corners.y)
                          + seen.w * uv_of(corners.z));
    }
    if (has_vertex_colours) {
        tint *= seen.y * vertex_colour_of(corners.x) + seen.z * vertex_colour_of(corners.y)
              + seen.w * vertex_colour_of(corners.z);
    }
    colour = vec4(mixed * tint, 1.0);
}
